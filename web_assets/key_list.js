// The list of keys, which "?" opens. It comes with the page (.wb-all-keys); a panel that is folded takes it out of the page,
// so the last one is kept.
"use strict";
{
  let list = null;

  function open() {
    list = document.querySelector(".wb-all-keys")?.innerHTML ?? list;
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

  addEventListener(
    "keydown",
    (event) => {
      const shown = document.querySelector(".wb-key-list");
      if (event.key !== "?" || (!shown && event.target instanceof Element && typedInto(event.target))) return;
      event.stopImmediatePropagation();
      if (shown) shown.close();
      else open();
    },
    true,
  );
}
