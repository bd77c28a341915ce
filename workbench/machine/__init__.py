"""What this machine has: installed versions, files, text, a browser, something to render with."""

DISTRIBUTION = "maniskill-workbench"
