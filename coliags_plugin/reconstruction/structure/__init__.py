"""Structure from motion and triangulation with known poses, by COLMAP."""
