"""The run of the open task: its state, its worker, its history, and the panels that show them."""
