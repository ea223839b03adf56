"""Presentation: one model of facts, tables and figures, written for the terminal, as HTML, Markdown, LaTeX and JSON."""
