"""View modules: what happens to a camera before, and to a picture after, a view is rendered."""
