"""The report: one self-contained page on which a person judges a result."""
