"""Files of hands in motion for other programs; nothing here reads them."""
