// What the server's style sheets call when they are in the page: bring into sight, open a tab. And "copy".
//
// The page's policy runs no code that is written in HTML, whoever put it there, but for a few fixed calls of what is
// here (HANDLERS in workbench/ui/server/responses.py). Values come from data attributes, never from the text of a handler.
"use strict";
{
  function copy(event) {
    const from = event.target instanceof Element && event.target.closest("[data-copy]");
    if (!from || (event.type === "keydown" && event.key !== "Enter" && event.key !== " ")) return;
    if (navigator.clipboard) {
      navigator.clipboard.writeText(from.dataset.copy);
      from.textContent = "copied";
    } else {
      prompt("Copy with Ctrl+C", from.dataset.copy);
    }
    if (event.type !== "keydown") return;
    event.preventDefault();
    event.stopImmediatePropagation(); // or Space would play
  }
  for (const kind of ["click", "keydown"]) addEventListener(kind, copy, true);

  Object.assign(window.wb, {
    // A style sheet tells when it is in the page. At once: a pill that is moved after it was seen is missed. And again,
    // since what stands beside it comes a moment later.
    intoSight(sheet) {
      const show = () => sheet.parentElement?.scrollIntoView({ block: "nearest" });
      show();
      setTimeout(show, 150);
    },

    // viser's tabs hear a key and a pointer that goes down and up, and no click.
    openTab(sheet) {
      const named = (tab) => tab.textContent.trim().replace(/ \d+$/, "") === sheet.dataset.openTab;
      const enter = { key: "Enter", code: "Enter", bubbles: true };
      [...document.querySelectorAll("[role=tab]")].find(named)?.dispatchEvent(new KeyboardEvent("keydown", enter));
      if (sheet.dataset.openFold) wb.openFold(sheet.dataset.openFold);
    },

    follow(sheet) {
      const row = document.querySelector(`.wb-library [data-row="${CSS.escape(sheet.dataset.follow)}"]`);
      row?.scrollIntoView({ block: "nearest" });
    },
  });
}
