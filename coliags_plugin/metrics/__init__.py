"""Image and depth metrics, and the evaluation protocols that fix how they are computed."""
