// The keys where they are looked for: in the tooltip of the button that does the same, and in a list that "?" opens.
//
// The palette shows a key as viser calls it (arrowleft) behind the name that people use: the former is taken away.
//
// viser's buttons have no tooltips of their own. Which key belongs to which button, and the list, come with the page
// (.wb-all-keys); a panel that is folded takes them out of the page, so the last ones are kept.
"use strict";
{
  let keys = {};
  let list = null;

  function read() {
    const told = document.querySelector(".wb-all-keys");
    if (!told) return;
    keys = JSON.parse(told.dataset.keys);
    list = told.innerHTML;
  }

  window.addEventListener(
    "pointerover",
    ({ target }) => {
      const button = target instanceof Element && target.closest("button");
      if (!button) return;
      read();
      const text = button.textContent.trim();
      // "undo reset of all": what is undone follows the name.
      const name = Object.keys(keys).find((one) => text === one || text.startsWith(`${one} `) || text.startsWith(`${one}:`));
      const title = name ? `${text} (${keys[name]})` : "";
      if (name ? button.title !== title : button.dataset.keyTitle) button.title = title;
      if (name) button.dataset.keyTitle = "yes";
      else delete button.dataset.keyTitle;
    },
    true,
  );

  new MutationObserver(() => {
    for (const { firstChild } of document.querySelectorAll(".mantine-Spotlight-actionDescription")) {
      const name = firstChild?.nodeValue?.replace(/ {2}\(.*\)$/, "");
      if (name && name !== firstChild.nodeValue) firstChild.nodeValue = name;
    }
  }).observe(document, { childList: true, subtree: true });

  function open() {
    read();
    if (!list) return;
    const dialog = document.createElement("dialog");
    dialog.className = "wb-key-list";
    dialog.setAttribute("aria-label", "Keys");
    dialog.innerHTML = list;
    dialog.addEventListener("close", () => dialog.remove());
    dialog.addEventListener("pointerdown", (event) => event.target === dialog && dialog.close());
    document.body.append(dialog);
    dialog.showModal();
  }

  const typedInto = (element) =>
    element.isContentEditable || element.matches("textarea, input:not([type=checkbox], [type=radio], [type=range])");

  window.addEventListener(
    "keydown",
    (event) => {
      const shown = document.querySelector(".wb-key-list");
      if (shown) {
        // The page's keys are about what lies below the list. Escape is the dialog's own.
        event.stopImmediatePropagation();
        if (event.key === "?") shown.close();
      } else if (event.key === "?" && event.target instanceof Element && !typedInto(event.target)) {
        event.stopImmediatePropagation();
        open();
      }
    },
    true,
  );
}
