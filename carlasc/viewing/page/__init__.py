"""One self-contained HTML file that any browser opens."""
