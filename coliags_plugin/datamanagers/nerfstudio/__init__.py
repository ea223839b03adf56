"""nerfstudio's ``transforms.json`` format."""
