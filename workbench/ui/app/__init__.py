"""The start page, the live page, the review page, and switching between them."""
