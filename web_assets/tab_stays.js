// Who comes back to a task, or to the review, finds the tab that was open there.
//
// Which tab is open is the browser's own matter, and a page that is built again begins with its first. The page says in
// `data-which` what it shows (which.html); what was chosen there is kept for as long as the browser's tab lives. Where the
// server asks for it (`data-says`), it is told which one is open.
"use strict";
{
  const KEEPS = "workbench tab of ";
  const LOOK = 100; // milliseconds
  const LOOKS = 50;
  let which = "";
  let looking = 0;
  let opening = false;

  const marker = () => document.querySelector("[data-which]");
  // Without the number of findings behind it.
  const nameOf = (tab) => tab.textContent.trim().replace(/ \d+$/, "");
  const tabsOf = (mark) => {
    const panel = mark?.closest(".mantine-Paper-root");
    return panel ? [...panel.querySelectorAll("[role=tab]")] : [];
  };

  function keep(event) {
    const tab = event.target instanceof Element && event.target.closest("[role=tab]");
    const mark = marker();
    if (!tab || !mark || !tabsOf(mark).includes(tab)) return;
    const name = nameOf(tab);
    sessionStorage.setItem(KEEPS + mark.dataset.which, name);
    if (!looking) return;
    clearTimeout(looking);
    looking = setTimeout(() => openAgain(name, 10), LOOK);
  }

  window.addEventListener("click", (event) => event.isTrusted && keep(event));
  // Enter opens a tab too, also that of the page (openTab): what is looked for here would take it back. Captured, since
  // viser lets no such key through.
  window.addEventListener("keydown", (event) => event.key === "Enter" && !opening && keep(event), true);

  // The tabs come one by one, a moment after the mark, and until all are there viser opens the first again.
  function openAgain(kept, looks) {
    const tab = tabsOf(marker()).find((one) => nameOf(one) === kept);
    // viser's tabs hear a key and a pointer that goes down and up, and no click.
    const enter = { key: "Enter", code: "Enter", bubbles: true };
    if (tab && tab.getAttribute("aria-selected") !== "true") {
      opening = true;
      tab.dispatchEvent(new KeyboardEvent("keydown", enter));
      opening = false;
    }
    const left = tab ? Math.min(looks, 10) - 1 : looks - 1;
    looking = looks > 0 ? setTimeout(() => openAgain(kept, left), LOOK) : 0;
  }

  let said = {};
  function sayWhichIsOpen() {
    const mark = marker();
    const open = mark && "says" in mark.dataset && tabsOf(mark).find((tab) => tab.getAttribute("aria-selected") === "true");
    if (!open || (said.mark === mark && said.tab === nameOf(open))) return;
    said = { mark, tab: nameOf(open) };
    wb.ask(["tell_open_tab", { tab: said.tab }]);
  }

  new MutationObserver(() => {
    sayWhichIsOpen();
    const now = marker()?.dataset.which ?? "";
    if (now === which) return;
    which = now;
    clearTimeout(looking);
    looking = 0;
    // Somebody was led here to watch something, which is in the first tab.
    if (marker()?.hasAttribute("data-anew")) sessionStorage.removeItem(KEEPS + now);
    const kept = sessionStorage.getItem(KEEPS + now);
    if (now && kept) openAgain(kept, LOOKS);
  }).observe(document, { childList: true, subtree: true, attributes: true, attributeFilter: ["data-which", "aria-selected"] });
}
