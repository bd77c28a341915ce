"""Access to this machine: installed versions, files, processes, text, a browser, a render device."""

DISTRIBUTION = "maniskill-workbench"
