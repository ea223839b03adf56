"""Light and reflectance: lamps, beams, photometry, interreflection and tone curves."""
