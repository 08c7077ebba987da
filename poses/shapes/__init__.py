"""Single poses of one hand."""
