// Features that viser's tabs, folds and palette lack. To request from viser: a tab group whose open tab the server can set, and
// which reports its open tab; folds that the server and the keyboard can open; palette commands that open an address.
//
//   data-which="3f2a"      id of the page's content: when the user returns to it, its last open tab is restored
//                          (with data-first-tab: its first tab)
//     data-says              report the open tab to the server
//   data-open-tab="Reward" open this tab, and in it the fold data-open-fold; the keys 1 to 9 open the tabs of the panel
//                          with data-which
//   data-toggle="timeline-open"  add or remove this attribute of <html>, for the style sheet
"use strict";
{
  const KEEPS = "workbench tab of ";
  const OPEN = "workbench open ";
  const COMES = 5000; // milliseconds within which the tabs appear
  const SETTLES = 1000; // milliseconds from when the wanted tab exists; until all tabs exist, viser reopens the first one
  const FOLD_COMES = 2000;

  // --- tabs -------------------------------------------------------------------------------------------------------------

  let which = "";
  let wanted = null; // { name, until }: the tab to restore
  let reported = { mark: null, name: "" };

  const nameOf = (tab) => tab.textContent.trim().replace(/ \d+$/, ""); // without the number of findings
  const marker = () => document.querySelector("[data-which]");
  const tabsOf = (mark) => [...(mark?.closest(".mantine-Paper-root")?.querySelectorAll("[role=tab]") ?? [])];
  const isOpen = (tab) => tab.getAttribute("aria-selected") === "true";

  // viser's tabs react to this key, and to pointer down and up.
  function press(tab) {
    tab.dispatchEvent(new KeyboardEvent("keydown", { key: "Enter", code: "Enter", bubbles: true }));
  }

  function keep(tab) {
    wanted = null;
    if (tabsOf(marker()).includes(tab)) sessionStorage.setItem(KEEPS + which, nameOf(tab));
  }
  // At pointer down, since viser opens a tab before the click.
  for (const kind of ["pointerdown", "keydown"]) {
    addEventListener(kind, (event) => {
      const tab = event.isTrusted && (kind === "pointerdown" || event.key === "Enter") && event.target.closest?.("[role=tab]");
      if (tab) keep(tab);
    }, true);
  }

  wb.arrivals.openTab = ({ dataset }) => {
    const tab = [...document.querySelectorAll("[role=tab]")].find((one) => nameOf(one) === dataset.openTab);
    if (tab) keep(tab);
    if (tab?.closest("[data-floating-window]")?.querySelector(".wb-drawer")) setOpen("data-timeline-open", true);
    if (tab) press(tab);
    if (dataset.openFold) openFold(dataset.openFold, performance.now() + FOLD_COMES);
  };

  addEventListener("keydown", (event) => {
    const tab = !heldIn(event) && !wb.isTyping() && tabsOf(marker())[Number(event.key) - 1];
    if (!tab || document.querySelector("[aria-modal=true]")) return;
    keep(tab);
    press(tab);
  });
  const heldIn = ({ ctrlKey, metaKey, altKey }) => ctrlKey || metaKey || altKey;

  // What is open stays open in this tab of the browser, also after a visit to the review and after a reload.
  const html = document.documentElement;
  function setOpen(name, isOpen) {
    html.toggleAttribute(name, isOpen);
    sessionStorage.setItem(OPEN + name, isOpen ? "1" : "");
  }
  wb.arrivals.toggle = ({ dataset }) => setOpen(`data-${dataset.toggle}`, !html.hasAttribute(`data-${dataset.toggle}`));
  wb.arrivals.openAddress = ({ dataset }) => {
    if ("newTab" in dataset) open(dataset.openAddress, "_blank", "noopener");
    else location.href = dataset.openAddress; // an editor's scheme: the page stays
  };
  if (sessionStorage.getItem(`${OPEN}data-timeline-open`)) html.setAttribute("data-timeline-open", "");

  // Help opens at the topic of the open tab.
  addEventListener("pointerdown", ({ target }) => {
    const link = target.closest?.("[data-topics]");
    const open = tabsOf(marker()).find(isOpen);
    if (link) link.href = `/help/${(open && JSON.parse(link.dataset.topics)[nameOf(open)]) || ""}`;
  }, true);

  function followTabs() {
    const mark = marker();
    const tabs = tabsOf(mark);
    if (mark && mark.dataset.which !== which) {
      which = mark.dataset.which;
      if ("firstTab" in mark.dataset) sessionStorage.removeItem(KEEPS + which);
      wanted = { name: sessionStorage.getItem(KEEPS + which), until: performance.now() + COMES };
    }
    const again = wanted && tabs.find((tab) => nameOf(tab) === wanted.name);
    if (again) wanted.until = Math.min(wanted.until, (wanted.since ??= performance.now()) + SETTLES);
    if (again && performance.now() > wanted.until) wanted = null;
    else if (again && !isOpen(again)) press(again);
    const open = mark && "says" in mark.dataset && tabs.find(isOpen);
    if (!open || (reported.mark === mark && reported.name === nameOf(open))) return;
    reported = { mark, name: nameOf(open) };
    wb.ask(["tell_open_tab", { tab: reported.name }]);
  }

  // --- folds: a fold is a sheet within a bordered sheet, with an arrow after its label; it reacts to clicks, not to keys ----

  const ARROW = "svg:is(.tabler-icon-chevron-down, .tabler-icon-chevron-up)";
  const ICONS = { "list-search": "Commands (Ctrl+K)", adjustments: "Scene tree and settings", "arrow-back": "Back to the panels" };
  const headings = () => [...document.querySelectorAll(`.mantine-Paper-root[data-with-border] > * > ${ARROW}`)].map((svg) => svg.parentElement);
  const isUnfolded = (heading) => Boolean(heading.querySelector(":scope > .tabler-icon-chevron-up"));

  function set(element, attributes) {
    for (const [name, value] of Object.entries(attributes)) if (element.getAttribute(name) !== value) element.setAttribute(name, value);
  }

  function nameFolds() {
    for (const heading of headings()) {
      const isEmpty = heading.querySelector(`:scope > ${ARROW}`).style.display === "none";
      if (isEmpty) for (const name of ["tabindex", "role", "aria-expanded", "data-fold"]) heading.removeAttribute(name);
      else set(heading, { tabindex: "0", role: "button", "aria-expanded": String(isUnfolded(heading)), "data-fold": heading.textContent.trim().split(" \u00b7 ")[0] }); // without its value
    }
    for (const [icon, label] of Object.entries(ICONS)) {
      for (const svg of document.querySelectorAll(`.mantine-ActionIcon-root svg.tabler-icon-${icon}`)) set(svg.closest("button"), { "aria-label": label });
    }
  }

  // The fold may be in another fold, or in a tab that was just opened.
  function openFold(label, until) {
    const heading = document.querySelector(`[data-fold="${CSS.escape(label)}"]`);
    if (!heading) {
      if (performance.now() < until) setTimeout(() => openFold(label, until), 50);
      return;
    }
    for (const one of headings()) if (one.parentElement.contains(heading) && !isUnfolded(one)) one.click();
    // Unfolding takes 200 ms, and the palette restores the previous focus.
    for (const after of [0, 250, 500]) {
      setTimeout(() => {
        heading.parentElement.scrollIntoView({ block: "start" });
        if (document.activeElement === document.body) heading.focus({ preventScroll: true });
      }, after);
    }
  }

  // --- the palette --------------------------------------------------------------------------------------------------------

  // A browser allows opening a tab only while it handles a press, and the server gets the command later: so the script opens
  // the document. Enter is a click too.
  addEventListener("click", ({ target }) => {
    const action = target.closest?.(".mantine-Spotlight-action");
    const textOf = (part) => action?.querySelector(`.mantine-Spotlight-action${part}`)?.textContent ?? "";
    if (textOf("Label").startsWith("Help: ")) open(textOf("Description") || "/help/", "_blank", "noopener");
  }, true);

  new MutationObserver(() => {
    nameFolds();
    followTabs();
  }).observe(document, { childList: true, subtree: true, attributes: true, attributeFilter: ["data-which", "aria-selected"] });
}
