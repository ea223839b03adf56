"""What a camera saw of a surface, and what it missed."""
