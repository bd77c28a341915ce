// The keys of the table of recordings are its own: they do nothing while it is folded away, and its search has two.
//
// viser's keys are the whole page's, and whether a panel is folded is known in the browser alone, which takes what is in
// it out of the page. Delete, T or the arrows would then be about a selection that nobody sees. Which keys those are says
// the status line of the review (review_status.html); while that is folded as well, what it said last counts.
//
// A question with a text field has the focus in it, where Escape would not be heard.
//
// In the search Escape shows all recordings again, and Enter goes back to the table, whose keys are not heard while
// somebody types.
"use strict";
{
  const SEARCH = "div:has(> div > .wb-library-pills) + div input";
  let keys = [];

  function named(event) {
    const held = [(event.ctrlKey || event.metaKey) && "cmd/ctrl", event.altKey && "alt", event.shiftKey && "shift"];
    return [...held.filter(Boolean), event.key.toLowerCase()].join("+");
  }

  function leaveSearch(event, field) {
    if (event.key === "Escape") {
      // As if it had been emptied by hand: the page hears of nothing else.
      Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(field, "");
      field.dispatchEvent(new Event("input", { bubbles: true }));
    }
    event.preventDefault();
    field.blur();
  }

  function leaveDialog(field) {
    field.blur();
    document.body.dispatchEvent(new KeyboardEvent("keydown", { key: "Escape", code: "Escape", bubbles: true }));
  }

  window.addEventListener(
    "keydown",
    (event) => {
      if (event.key === "Escape" && event.target instanceof HTMLInputElement && event.target.closest("[role=dialog]")) {
        leaveDialog(event.target);
        return;
      }
      if ((event.key === "Escape" || event.key === "Enter") && event.target instanceof Element && event.target.matches(SEARCH)) {
        leaveSearch(event, event.target);
        return;
      }
      const status = document.querySelector(".wb-status");
      if (status) keys = (status.dataset.libraryKeys || "").split(" ");
      const aside = event.target !== document.body && !(event.target instanceof HTMLButtonElement);
      if (aside || !keys.includes(named(event)) || document.querySelector(".wb-library-tools")) return;
      event.stopImmediatePropagation();
    },
    true,
  );
}
