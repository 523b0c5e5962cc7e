"""The kinds of test that laboratories run: their files, as they write them."""
