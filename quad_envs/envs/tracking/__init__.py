"""One vehicle follows a reference: the environments and their compiled step."""
