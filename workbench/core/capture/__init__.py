"""What is read out of a running env: for a person, and for a recording."""
