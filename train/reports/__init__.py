"""Reports: HTML pages and tables about training sets and training runs."""
