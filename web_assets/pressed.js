// What the handlers in the server's templates do: press, choose, place, copy, bring into sight, open a tab.
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

  window.wb = {
    // With a counter in front: an input whose value stays the same sends nothing.
    send(input, number) {
      presses = (presses + 1) % 89;
      type(input, presses * 1e8 + number);
    },

    press(event) {
      if (counts(event)) document.getElementById(event.target.closest("[data-press]")?.dataset.press)?.click();
    },

    choose(event, table) {
      const row = event.target.closest("[data-row]");
      const input = document.getElementById(table.dataset.numbers);
      const tick = event.target.closest(".wb-tick");
      const twice = event.type === "dblclick";
      if (!row || !input || (twice ? tick : !counts(event))) return;
      const held = (event.ctrlKey || event.metaKey || tick ? 1 : 0) + (event.shiftKey ? 2 : 0);
      wb.send(input, row.dataset.row * 8 + (twice ? 4 : held));
    },

    place(event) {
      const picture = event.target.closest("[data-place]");
      const input = picture && event.button === 0 && document.getElementById(picture.dataset.place);
      if (!input) return;
      const box = picture.getBoundingClientRect();
      const part = (at, from, size) => Math.max(0, Math.min(9999, Math.floor(((at - from) / size) * 10000)));
      const place = part(event.clientX, box.left, box.width) * 10000 + part(event.clientY, box.top, box.height);
      type(input, (Date.now() % 89) * 1e8 + place);
    },

    // A place on a timeline's strip, or the event whose mark is pressed.
    pick(event) {
      const strip = event.target.closest("[data-pick]");
      const input = strip && event.button === 0 && document.getElementById(strip.dataset.pick);
      if (!input) return;
      const [low, high] = [Number(strip.dataset.low), Number(strip.dataset.high)];
      const box = strip.getBoundingClientRect();
      const part = Math.max(0, Math.min(1, (event.clientX - box.left) / box.width));
      wb.send(input, Number(event.target.closest("[data-at]")?.dataset.at ?? Math.round(low + part * (high - low))) - low);
    },

    copy(event) {
      const from = event.target.closest("[data-copy]");
      if (!from || event.button !== 0) return;
      if (navigator.clipboard) {
        navigator.clipboard.writeText(from.dataset.copy);
        from.textContent = "copied";
      } else {
        prompt("Copy with Ctrl+C", from.dataset.copy);
      }
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
    },

    follow(sheet) {
      const row = document.querySelector(`.wb-library [data-row="${CSS.escape(sheet.dataset.follow)}"]`);
      row?.scrollIntoView({ block: "nearest" });
    },
  };
}
