// The keyboard in the list of tasks: what is typed goes to its search, the arrows walk through the rows, Enter opens one.
//
// The marked row is the browser's own matter: two people at two browsers do not move each other's. Enter asks for what a press
// on the row would (input.js). It waits until the list is that of the words in the field: they
// arrive a moment after they were typed, and it would open what was marked before.
//
// The list follows its folder: where a row comes or goes above the one under the pointer, the page is scrolled by as much.
"use strict";
{
  const PATIENCE = 2000; // milliseconds
  let marked = "";
  let words = "";

  const lists = () => [...document.querySelectorAll(".wb-tasks")].at(-1);
  const rowsOf = (list) => [...list.querySelectorAll("[data-row]")];

  function searchOf(list) {
    for (let around = list.parentElement; around; around = around.parentElement) {
      const field = around.querySelector("input[type=text], input:not([type])");
      if (field) return field;
    }
    return null;
  }

  function mark(list, number, intoSight) {
    marked = number;
    for (const row of rowsOf(list)) {
      const is = row.dataset.row === number;
      row.classList.toggle("wb-marked-task", is);
      if (is && intoSight) row.scrollIntoView({ block: "nearest" });
    }
  }

  function markAgain(list) {
    const rows = rowsOf(list);
    // The best match of other words is the first that is not open already.
    const best = rows.find((row) => !("open" in row.dataset)) ?? rows[0];
    if (list.dataset.words !== words || !rows.some((row) => row.dataset.row === marked)) marked = best?.dataset.row ?? "";
    words = list.dataset.words;
    if (rows.some((row) => row.classList.contains("wb-marked-task") !== (row.dataset.row === marked))) mark(list, marked);
  }

  function walk(list, key) {
    const rows = rowsOf(list);
    const at = rows.findIndex((row) => row.dataset.row === marked);
    const here = rows[at]?.getBoundingClientRect();
    const step = { ArrowDown: 1, ArrowRight: 1, ArrowUp: -1, ArrowLeft: -1 }[key];
    // Of the cards, up and down lead to the card above and below.
    const next = rows.findIndex((row, k) => {
      const box = row.getBoundingClientRect();
      return step > 0 && k > at && (key === "ArrowRight" || !here || (box.top > here.top + 4 && box.right > here.left + 4));
    });
    const before = rows.findLastIndex((row, k) => {
      const box = row.getBoundingClientRect();
      return step < 0 && k < at && (key === "ArrowLeft" || (box.top < here.top - 4 && box.left <= here.left + 4));
    });
    const to = step > 0 ? next : before;
    if (to >= 0) mark(list, rows[to].dataset.row, true);
  }

  function open(since) {
    const list = lists();
    if (!list || performance.now() - since > PATIENCE) return;
    const field = searchOf(list);
    if (field && field.value.trim() !== list.dataset.words.trim()) {
      setTimeout(() => open(since), 30);
      return;
    }
    markAgain(list);
    const row = list.querySelector(`[data-row="${CSS.escape(marked)}"]`);
    if (row) wb.ask(JSON.parse(row.dataset.do));
  }

  window.addEventListener(
    "keydown",
    (event) => {
      const list = lists();
      if (!list || event.ctrlKey || event.metaKey || event.altKey) return;
      const asked = [...document.querySelectorAll("[role=dialog]")].at(-1);
      if (asked && !asked.contains(list)) return; // a question over the list
      const field = searchOf(list);
      const elsewhere = event.target instanceof Element && event.target.matches("input, textarea, select, button, summary, a[href], .wb-button");
      if (event.target !== field && elsewhere) return;
      const key = event.key;
      const sideways = key === "ArrowLeft" || key === "ArrowRight";
      if (key === "ArrowDown" || key === "ArrowUp" || (sideways && (event.target !== field || !field.value))) walk(list, key);
      else if (key === "Enter") open(performance.now());
      else if (key === "Escape" && field?.value) {
        field.value = "";
        field.dispatchEvent(new Event("input", { bubbles: true }));
      } else {
        // The letter itself goes into the field, which has the focus by then; and no key of the page below acts.
        if (key.length === 1 && event.target !== field) field?.focus();
        if (key.length === 1) event.stopImmediatePropagation();
        return;
      }
      event.preventDefault();
      event.stopImmediatePropagation();
    },
    true,
  );

  window.addEventListener("pointerdown", (event) => {
    const row = event.target instanceof Element && event.target.closest(".wb-tasks [data-row]");
    if (row) mark(row.closest(".wb-tasks"), row.dataset.row);
  });

  let pointer = null; // where it is, and the row under it
  const rowAt = (x, y) => document.elementFromPoint(x, y)?.closest(".wb-tasks [data-row]");
  function remember(x, y) {
    const row = rowAt(x, y);
    pointer = { x, y, row: row?.dataset.row, top: row?.getBoundingClientRect().top, words: lists()?.dataset.words };
  }
  window.addEventListener("pointermove", ({ clientX, clientY }) => lists() && remember(clientX, clientY), true);
  window.addEventListener("scroll", () => pointer && lists() && remember(pointer.x, pointer.y), true);

  function keepUnderPointer(list) {
    if (!pointer?.row || pointer.words !== list.dataset.words) return;
    const row = list.querySelector(`[data-row="${CSS.escape(pointer.row)}"]`);
    const moved = row ? row.getBoundingClientRect().top - pointer.top : 0;
    for (let around = list; moved && around; around = around.parentElement) {
      if (around.scrollHeight > around.clientHeight && ["auto", "scroll"].includes(getComputedStyle(around).overflowY)) {
        around.scrollTop += moved;
        return;
      }
    }
  }

  let search = null; // the field that was given the focus
  new MutationObserver(() => {
    const list = lists();
    if (!list) {
      search = null;
      return;
    }
    keepUnderPointer(list);
    markAgain(list);
    const field = searchOf(list);
    if (!field || field === search) return;
    search = field; // It may come after the list, or anew.
    words = list.dataset.words;
    field.focus({ preventScroll: true });
  }).observe(document, { childList: true, subtree: true });
}
