// What a press on the server's HTML does: press, choose, place, pick, copy; and what its style sheets call when they are
// in the page: bring into sight, open a tab.
//
// The page's policy runs no code that is written in HTML, whoever put it there, but for a few fixed calls of what is
// here (HANDLERS in workbench/ui/server/responses.py). Values come from data attributes, never from the text of a handler.
"use strict";
{
  const setValue = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set;
  let presses = 0;

  // As if it had been typed: an input of viser's hears the event, and React only looks when the value is another.
  function type(input, number) {
    setValue.call(input, number);
    input.dispatchEvent(new Event("input", { bubbles: true }));
  }

  // The mouse counts when it goes down, since a table may be drawn anew before it comes up; a touch when it is over,
  // or scrolling would press.
  const counts = (event) =>
    event.type === "pointerdown" ? event.pointerType === "mouse" && event.button === 0 : event.pointerType !== "mouse";

  const of = (event, what) => (event.target instanceof Element ? event.target.closest(`[${what}]`) : null);

  function press(event) {
    const part = of(event, "data-press");
    if (part && counts(event)) document.getElementById(part.dataset.press)?.click();
  }

  function choose(event) {
    const row = of(event, "data-row");
    const input = document.getElementById(row?.closest("[data-numbers]")?.dataset.numbers);
    const tick = of(event, "class~=wb-tick");
    const twice = event.type === "dblclick";
    if (!row || !input || (twice ? tick : !counts(event))) return;
    const held = (event.ctrlKey || event.metaKey || tick ? 1 : 0) + (event.shiftKey ? 2 : 0);
    wb.send(input, row.dataset.row * 8 + (twice ? 4 : held));
  }

  function place(event) {
    const picture = of(event, "data-place");
    const input = picture && event.button === 0 && document.getElementById(picture.dataset.place);
    if (!input) return;
    const box = picture.getBoundingClientRect();
    const part = (at, from, size) => Math.max(0, Math.min(9999, Math.floor(((at - from) / size) * 10000)));
    const at = part(event.clientX, box.left, box.width) * 10000 + part(event.clientY, box.top, box.height);
    type(input, (Date.now() % 89) * 1e8 + at);
  }

  // A place on a timeline's strip, or the event whose mark is pressed.
  function pick(event) {
    const strip = of(event, "data-pick");
    const input = strip && event.button === 0 && document.getElementById(strip.dataset.pick);
    if (!input) return;
    const [low, high] = [Number(strip.dataset.low), Number(strip.dataset.high)];
    const box = strip.getBoundingClientRect();
    const part = Math.max(0, Math.min(1, (event.clientX - box.left) / box.width));
    wb.send(input, Number(of(event, "data-at")?.dataset.at ?? Math.round(low + part * (high - low))) - low);
  }

  function copy(event) {
    const from = of(event, "data-copy");
    if (!from || event.button !== 0) return;
    if (navigator.clipboard) {
      navigator.clipboard.writeText(from.dataset.copy);
      from.textContent = "copied";
    } else {
      prompt("Copy with Ctrl+C", from.dataset.copy);
    }
  }

  // For the whole page, once: a template that has to bring its own handlers may forget one, and then its links are dead.
  const heard = { pointerdown: [press, choose, place, pick, copy], click: [press, choose], dblclick: [choose] };
  for (const [type, all] of Object.entries(heard)) {
    document.addEventListener(type, (event) => all.forEach((one) => one(event)), true); // viser's panels stop some
  }

  window.wb = {
    // With a counter in front: an input whose value stays the same sends nothing.
    send(input, number) {
      presses = (presses + 1) % 89;
      type(input, presses * 1e8 + number);
    },

    // A style sheet tells when it is in the page. At once: a pill that is moved after it was seen is missed. And again,
    // since what stands beside it comes a moment later.
    intoSight(sheet) {
      const named = sheet.dataset.intoSight;
      const target = () => (named ? document.getElementById(named) : sheet.parentElement);
      const show = () => target()?.scrollIntoView({ block: "nearest" });
      show();
      setTimeout(show, 150);
    },

    // viser's tabs hear a key and a pointer that goes down and up, and no click.
    openTab(sheet) {
      const named = (tab) => tab.textContent.trim().replace(/ \d+$/, "") === sheet.dataset.openTab;
      const enter = { key: "Enter", code: "Enter", bubbles: true };
      [...document.querySelectorAll("[role=tab]")].find(named)?.dispatchEvent(new KeyboardEvent("keydown", enter));
      if (sheet.dataset.openFold) wb.openFold(sheet.dataset.openFold);
    },

    follow(sheet) {
      const row = document.querySelector(`.wb-library [data-row="${CSS.escape(sheet.dataset.follow)}"]`);
      row?.scrollIntoView({ block: "nearest" });
    },
  };
}
