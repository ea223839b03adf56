"""Plain data and small tools that every package may use."""
