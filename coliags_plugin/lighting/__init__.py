"""Light: lamps, photometry and interreflection."""
