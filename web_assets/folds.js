// Every fold of viser's is reached with the Tab key and opened with Enter or Space.
//
// Its heading is a `div` that hears a click alone, so what a button says of itself is added to it. The heading is found
// by what viser draws: a sheet within a bordered sheet, with an arrow behind its label. A page that is drawn anew has
// another heading: the focus goes to the one of the same label.
"use strict";
{
  const ARROWS = "svg.tabler-icon-chevron-down, svg.tabler-icon-chevron-up";
  const GONE = 1500; // milliseconds without it, after which a heading is not waited for
  const TRIES = 40; // of 50 ms; a tab comes some frames after it was opened
  let walked = null; // { label, element } of the heading that was reached by key
  let missedSince = 0;

  const isHeading = (svg) => svg.parentElement?.parentElement?.matches(".mantine-Paper-root[data-with-border]");
  const arrowOf = (heading) => heading.querySelector(":scope > svg");
  const isOpen = (heading) => arrowOf(heading).matches(".tabler-icon-chevron-up");
  const labelOf = (heading) => heading.textContent.trim();
  const headings = () => [...document.querySelectorAll(ARROWS)].filter(isHeading).map((svg) => svg.parentElement);

  // Icons of viser's header have no name.
  const ICONS = { "list-search": "Commands (Ctrl+K)", adjustments: "Scene tree and settings", "arrow-back": "Back to the panels" };

  function set(element, name, value) {
    if (element.getAttribute(name) !== value) element.setAttribute(name, value);
  }

  function name() {
    for (const heading of headings()) {
      if (arrowOf(heading).style.display === "none") {
        for (const one of ["tabindex", "role", "aria-expanded"]) heading.removeAttribute(one);
        continue;
      }
      set(heading, "tabindex", "0");
      set(heading, "role", "button");
      set(heading, "aria-expanded", String(isOpen(heading)));
    }
    for (const [icon, label] of Object.entries(ICONS)) {
      for (const svg of document.querySelectorAll(`.mantine-ActionIcon-root svg.tabler-icon-${icon}`)) set(svg.closest("button"), "aria-label", label);
    }
  }

  window.addEventListener(
    "keydown",
    (event) => {
      const { key, target } = event;
      if ((key !== "Enter" && key !== " ") || !(target instanceof Element) || !headings().includes(target)) return;
      target.click();
      event.preventDefault();
      event.stopImmediatePropagation(); // or Space would play
    },
    true,
  );

  window.addEventListener("focusin", ({ target }) => {
    walked = headings().includes(target) ? { label: labelOf(target), element: target } : null;
  });
  window.addEventListener("focusout", ({ target, relatedTarget }) => target.isConnected && relatedTarget && (walked = null));
  window.addEventListener("pointerdown", ({ isTrusted }) => isTrusted && (walked = null), true);

  function focusAgain() {
    if (!walked || walked.element.isConnected || document.activeElement !== document.body) return;
    const again = headings().find((heading) => labelOf(heading) === walked.label);
    missedSince = again ? 0 : missedSince || Date.now();
    if (again) again.focus({ preventScroll: true });
    else if (Date.now() - missedSince > GONE) walked = null;
  }

  // The palette opens one by its label, maybe in another fold, maybe in a tab that was just opened.
  wb.openFold = (label, tries = TRIES) => {
    const heading = headings().find((one) => labelOf(one) === label && one.tabIndex === 0);
    if (!heading) {
      if (tries) setTimeout(() => wb.openFold(label, tries - 1), 50);
      return;
    }
    for (const one of headings()) if (one.parentElement.contains(heading) && !isOpen(one)) one.click();
    // It unfolds for 200 ms, and the palette gives the focus back to where it was.
    for (const after of [0, 250, 500]) {
      setTimeout(() => {
        heading.parentElement.scrollIntoView({ block: "start" });
        if (document.activeElement === document.body) heading.focus({ preventScroll: true });
      }, after);
    }
  };

  new MutationObserver(() => {
    name();
    focusAgain();
  }).observe(document, { childList: true, subtree: true });
}
