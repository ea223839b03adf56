"""Files of Gaussians as other programs read and write them: PLY, SPZ, glTF."""
