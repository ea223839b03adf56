"""C3VD: the raw release and the undistorted layout."""
