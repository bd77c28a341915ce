"""The live session and the review: what the page asks for and what it sees."""
