// Keeps one complaint of viser's out of the console: its sorter of Gaussian splats, of which the workbench shows none,
// makes functions from text when the page is loaded, which the page's policy forbids.
"use strict";
window.addEventListener("unhandledrejection", (event) => {
  if (event.reason instanceof EvalError) event.preventDefault();
});
