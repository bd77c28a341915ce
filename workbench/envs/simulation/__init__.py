"""N CPU physics systems behind the interface of one GPU system."""
