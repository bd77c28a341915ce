// The browser's tab is called after the task, or after what else the page shows.
//
// viser's page is called "Viser", whatever is in it, and two tasks side by side cannot be told apart. The status line says
// in `data-title` what the page is about. While its panel is folded it is not in the page, and the tab keeps its name.
"use strict";
{
  document.title = "Workbench";

  new MutationObserver(() => {
    const title = document.querySelector("[data-title]")?.dataset.title;
    if (title && title !== document.title) document.title = title;
  }).observe(document, { childList: true, subtree: true, attributes: true, attributeFilter: ["data-title"] });
}
