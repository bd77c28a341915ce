// What was typed or pressed arrives before the key that comes after it.
//
// viser's page sends one message every 50 ms, and of those that are to be sent in between only the last
// (WebsocketUtils.ts). Enter is a message like a letter: pressed at once after one, it took the letter's place, and what
// was kept lacked the last letters. A key of a command is sent at once: it came before the press on the row that it was
// for. So both wait until what came before is on its way. By a timer, and not by the clock: a page that is busy hears of
// keys before its timers have their turn, however late that is, and of timers those that are due first come first.
"use strict";
{
  const SENT_WITHIN = 60; // milliseconds; a little more than viser takes
  // Here the browser itself does something with a key, which it does for no event of ours.
  const HEARS_KEYS = "input, textarea, select, button, summary, a[href], [contenteditable], [role=slider]";
  let typed = false;
  let pressed = 0; // presses whose messages may not be on their way yet
  let waiting = 0;

  window.addEventListener("input", () => (typed = true), true);
  const press = () => {
    pressed += 1;
    setTimeout(() => (pressed -= 1), SENT_WITHIN);
  };
  for (const kind of ["pointerdown", "click"]) window.addEventListener(kind, press, true);

  window.addEventListener(
    "keydown",
    (event) => {
      const target = event.target;
      if (!event.isTrusted || !(target instanceof Element) || target.matches(HEARS_KEYS)) return;
      // The browser moves the focus for no event of ours, so Tab, pressed again and again after a click, would move nothing.
      if (event.key === "Tab") return;
      if (!waiting && !pressed) return;
      event.preventDefault();
      event.stopImmediatePropagation();
      waiting += 1;
      setTimeout(() => {
        waiting -= 1;
        (target.isConnected ? target : document.body).dispatchEvent(new KeyboardEvent("keydown", event));
      }, SENT_WITHIN);
    },
    true,
  );

  // On the window and first: viser hears it after this.
  window.addEventListener(
    "submit",
    (event) => {
      const form = event.target;
      if (!typed) return;
      typed = false;
      event.preventDefault();
      event.stopImmediatePropagation();
      setTimeout(() => form.isConnected && form.requestSubmit(), SENT_WITHIN);
    },
    true,
  );
}
