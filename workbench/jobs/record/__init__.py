"""Records episodes, solves tasks and sweeps over settings: work whose items are episodes."""
