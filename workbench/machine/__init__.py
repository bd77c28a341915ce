"""What this machine has: files, text, a browser, something to render with."""

DISTRIBUTION = "maniskill-workbench"
