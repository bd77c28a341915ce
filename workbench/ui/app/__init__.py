"""The live page, the review page, and switching between them."""
