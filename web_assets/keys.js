// A control that was clicked gives the focus back, so that the page's keys go on working.
//
// viser's keys are heard on the document, but never while the focus is in an <input>, which a ticked checkbox and a
// dropdown are too; and a tab or a button that was clicked takes the arrows and the space for itself. So once the
// pointer is up, the focus stays only where somebody types: in a text or number field, or in a dropdown that is open.
// A click on the view, out of such a field, gives the keys back and no more: it selects no env. So do Enter and Escape.
// Whoever walks through the controls with the Tab key presses no pointer, and keeps the focus, also when they press
// Enter; and there Space and Enter are that control's, as everywhere else: else Space would play instead of pressing it.
"use strict";
{
  const NOT_TYPED_INTO = ["checkbox", "radio", "range", "button", "submit", "reset", "color", "file"];

  const LATER = 50; // milliseconds

  function isTypedInto(element) {
    if (element.isContentEditable || element instanceof HTMLTextAreaElement) return true;
    if (!(element instanceof HTMLInputElement) || NOT_TYPED_INTO.includes(element.type)) return false;
    return element.getAttribute("aria-haspopup") !== "listbox" || element.getAttribute("aria-expanded") === "true";
  }

  function giveBack(event) {
    if (event.type === "click" && event.detail === 0) return; // by a key, or by a script
    const focused = document.activeElement;
    if (!focused || focused === document.body) return;
    // The view keeps the browser from moving the focus when it is clicked, also out of a field.
    if (!isTypedInto(focused) || event.target instanceof HTMLCanvasElement) focused.blur();
  }

  let again = 0;
  let givesKeys = false; // the last press on the view was out of a field

  window.addEventListener(
    "pointerdown",
    ({ target }) => {
      givesKeys = target instanceof HTMLCanvasElement && !!document.activeElement && isTypedInto(document.activeElement);
    },
    true,
  );

  const postMessage = Worker.prototype.postMessage;
  Worker.prototype.postMessage = function (message, ...rest) {
    if (givesKeys && message?.type === "send" && message.message?.type === "ScenePointerMessage") return;
    return postMessage.call(this, message, ...rest);
  };

  const PRESSED_BY_KEY = "button, summary, a[href], input[type=checkbox], input[type=radio]";

  window.addEventListener(
    "keydown",
    (event) => {
      clearTimeout(again); // or a key that comes soon after a click would lose what it has just walked to
      if ((event.key !== " " && event.key !== "Enter") || !(event.target instanceof Element)) return;
      // The browser presses it all the same; our own HTML has no such control and hears its keys itself.
      if (event.target.matches(PRESSED_BY_KEY) && !event.target.matches("[data-press]")) event.stopImmediatePropagation();
    },
    true,
  );

  // Last, when the field has taken the key (typed_numbers.js). A list and a dialog have their own use for both keys.
  window.addEventListener("keydown", ({ key, target }) => {
    if ((key !== "Enter" && key !== "Escape") || !(target instanceof HTMLInputElement) || !isTypedInto(target)) return;
    if (target.getAttribute("aria-haspopup") !== "listbox" && !target.closest("[role=dialog]")) target.blur();
  });

  // On the window and first: what is pressed may keep the event from going further.
  for (const kind of ["pointerup", "click"]) {
    window.addEventListener(
      kind,
      (event) => {
        giveBack(event);
        // Again: some controls take the focus, or close their list, in handlers that come after this one.
        clearTimeout(again);
        again = setTimeout(() => giveBack(event), LATER);
      },
      true,
    );
  }
}
