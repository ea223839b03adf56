"""Names to components, and YAML to validated method configs."""
