"""What is made of recordings to be handed on."""
