// What is typed right after Ctrl+K or Ctrl+O goes into the window that these keys open, and triggers no key of the page.
//
// The palette takes some frames to open, and the list of tasks comes from the server. Until a field of theirs has the
// focus, keys are held here; then the letters are written into it, and Enter is pressed.
"use strict";
{
  const PATIENCE = 3000; // milliseconds, after which no window is waited for
  const WINDOW = "[role=dialog], .mantine-Spotlight-content";
  const setValue = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set;
  let held = null;
  let until = 0;

  const opens = ({ key, ctrlKey, metaKey, shiftKey, altKey }) =>
    (ctrlKey || metaKey) && !altKey && (shiftKey ? ["p"] : ["k", "o"]).includes(key.toLowerCase());

  function release(field) {
    const letters = held.filter((key) => key.length === 1).join("");
    const enter = held.includes("Enter");
    held = null;
    if (letters) {
      setValue.call(field, letters);
      field.dispatchEvent(new Event("input", { bubbles: true }));
    }
    // Once the list is that of the letters.
    if (enter) setTimeout(() => field.dispatchEvent(new KeyboardEvent("keydown", { key: "Enter", code: "Enter", bubbles: true, cancelable: true })), 100);
  }

  window.addEventListener(
    "keydown",
    (event) => {
      const { key, target, ctrlKey, metaKey, altKey } = event;
      if (held && performance.now() > until) held = null;
      if (opens(event) && !held) {
        const typed = target instanceof Element && target.matches("input, textarea, select, [contenteditable]");
        if (typed || document.querySelector(".wb-start")) return;
        held = [];
        until = performance.now() + PATIENCE;
        return;
      }
      if (!held) return;
      if (key === "Escape") held = null;
      else if (key === "Backspace") held.pop();
      else if ((key.length === 1 || key === "Enter") && !ctrlKey && !metaKey && !altKey) held.push(key);
      else return;
      event.preventDefault();
      event.stopImmediatePropagation();
    },
    true,
  );

  window.addEventListener("focusin", ({ target }) => {
    if (held && target instanceof HTMLInputElement && target.closest(WINDOW)) release(target);
  });
}
