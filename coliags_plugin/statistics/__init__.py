"""Statistics of methods compared over scenes, the unit of every mean, test and interval; never the frame."""
