"""Coverage: surface that a camera saw, and surface that it missed."""
