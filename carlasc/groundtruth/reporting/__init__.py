"""The report of a grid: its content, how it was made, and digests that show later changes."""
