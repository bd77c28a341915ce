"""What the machine at hand can do, and bringing what it lacks: render driver, browser, system libraries."""

DISTRIBUTION = "maniskill-workbench"
