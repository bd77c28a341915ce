"""Parts of every page: commands, the door, widgets, and the 3-D view. Only panels and this folder import viser."""
