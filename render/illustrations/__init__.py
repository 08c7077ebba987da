"""Ready-made pictures for pages, drawn without OpenGL."""
