"""The steps of a test and the protocols built from them."""
