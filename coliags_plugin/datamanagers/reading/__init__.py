"""Files of any data set: images, depth, points, and what they are called."""
