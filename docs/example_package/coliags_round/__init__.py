"""Round Gaussians, a smoothness loss and a vignette for coliags_plugin: an example of a package of components."""
