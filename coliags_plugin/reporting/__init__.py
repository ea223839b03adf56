"""Reports: figures, charts and pictures of runs on one page."""
