// Who comes back to a task, or to the review, finds the tab that was open there.
//
// Which tab is open is the browser's own matter, and a page that is built again begins with its first. The page says in
// `data-which` what it shows (which.html); what was chosen there is kept for as long as the browser's tab lives.
"use strict";
{
  const KEEPS = "workbench tab of ";
  let which = "";

  const marker = () => document.querySelector("[data-which]");
  const tabsOf = (mark) => {
    const panel = mark?.closest(".mantine-Paper-root");
    return panel ? [...panel.querySelectorAll("[role=tab]")] : [];
  };

  window.addEventListener("click", (event) => {
    const tab = event.target instanceof Element && event.target.closest("[role=tab]");
    const mark = marker();
    if (tab && mark && tabsOf(mark).includes(tab)) sessionStorage.setItem(KEEPS + mark.dataset.which, tab.textContent);
  });

  new MutationObserver(() => {
    const mark = marker();
    const now = mark?.dataset.which ?? "";
    if (now === which) return;
    if (!now) {
      which = "";
      return;
    }
    const tabs = tabsOf(mark);
    if (!tabs.length) return; // they come a moment later
    which = now;
    const kept = sessionStorage.getItem(KEEPS + now);
    const tab = tabs.find((one) => one.textContent === kept);
    if (tab && tab.getAttribute("aria-selected") !== "true") tab.click();
  }).observe(document, { childList: true, subtree: true, attributes: true, attributeFilter: ["data-which"] });
}
