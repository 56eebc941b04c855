"""A page to share: one HTML file that any browser opens."""
