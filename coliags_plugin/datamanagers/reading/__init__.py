"""Files of any data set: pictures, depth, points, and what they are called."""
