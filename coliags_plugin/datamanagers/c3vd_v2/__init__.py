"""The C3VDv2 dataset."""
