// What is pressed with the mouse in our own HTML (pills, rows of a table, "copy") is pressed with Enter or Space too.
//
// The server's templates say what can be pressed (data-press, data-copy, data-row) and what the Tab key stops at
// (tabindex). What a press does is in their handlers, which hear a pointer; so a key becomes one here. Of a table or
// a strip (data-roving) Tab stops at one part, and the arrows go from there to the others.
//
// Such HTML is replaced whenever what it says changes, also by the very press, and the focus goes with it: the keyboard
// would start again at the top of the page. So the focused part is found again in the new HTML, by the id of what it
// presses. The capture phase, on the window: or Space would play, and the arrows scrub.
"use strict";
{
  const PARTS = "[data-press], [data-copy], [data-row]";
  const STEPS = { ArrowLeft: -1, ArrowUp: -1, ArrowRight: 1, ArrowDown: 1 };
  const GONE = 1500; // milliseconds without it, after which a part is not waited for
  let walkedTo = "";
  let byPointer = false; // what is clicked gives the focus back (keys.js), and must not get it again
  let missedSince = 0;

  function press(part, event) {
    const { ctrlKey, metaKey, shiftKey } = event;
    const as = { bubbles: true, button: 0, pointerType: "mouse", ctrlKey, metaKey, shiftKey };
    part.dispatchEvent(new PointerEvent("pointerdown", as));
  }

  function goBy(step, part, list) {
    const parts = [...list.querySelectorAll("[tabindex][data-press]")];
    parts[parts.indexOf(part) + step]?.focus();
  }

  window.addEventListener(
    "keydown",
    (event) => {
      byPointer = false;
      remember(event);
      if (event.key === "Tab") walkedTo = ""; // or the last part of the page would get the focus back for ever
      const part = event.target instanceof Element && event.target.matches(PARTS) ? event.target : null;
      if (!part || event.altKey) return;
      const list = part.closest("[data-roving]");
      if (event.key === "Enter" || event.key === " ") press(part, event);
      else if (list && STEPS[event.key] && !event.ctrlKey && !event.metaKey) goBy(STEPS[event.key], part, list);
      else return;
      event.preventDefault();
      event.stopImmediatePropagation();
    },
    true,
  );

  function remember({ target }) {
    const walked = !byPointer && target instanceof Element && target.matches("[data-press]");
    walkedTo = (walked && target.dataset.press) || "";
  }

  window.addEventListener("focusin", remember);
  // Between the part that Tab leaves and the next one nothing has the focus. A change of the page in that moment would
  // bring the focus back to the first.
  window.addEventListener("focusout", ({ relatedTarget }) => relatedTarget && (walkedTo = ""));
  window.addEventListener(
    "pointerdown",
    (event) => {
      if (!event.isTrusted) return;
      walkedTo = "";
      byPointer = true;
    },
    true,
  );

  new MutationObserver(() => {
    if (!walkedTo || document.activeElement !== document.body) return;
    const again = document.querySelector(`[tabindex][data-press="${CSS.escape(walkedTo)}"]`);
    if (again) again.focus({ preventScroll: true });
    else if (!missedSince) missedSince = Date.now();
    else if (Date.now() - missedSince > GONE) walkedTo = "";
    if (again || !walkedTo) missedSince = 0;
  }).observe(document, { childList: true, subtree: true });
}
