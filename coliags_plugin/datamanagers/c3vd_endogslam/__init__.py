"""C3VD as EndoGSLAM prepared it, and PR-Endo's release."""
