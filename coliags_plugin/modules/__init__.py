"""View modules: adjustments of camera and output per view."""
