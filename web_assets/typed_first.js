// What was typed arrives before the Enter that ends it.
//
// viser's page sends one message every 50 ms, and of those that are to be sent in between only the last
// (WebsocketUtils.ts). Enter is a message like a letter: pressed at once after one, it took the letter's place, and what
// was kept lacked the last letters. So Enter in a form that was typed into waits until the letters are on their way. By a
// timer, also where some time has passed: a page that is busy hears of all keys before its timers have their turn, and
// of timers those that are due first come first.
"use strict";
{
  const SENT_WITHIN = 60; // milliseconds; a little more than viser takes
  let typed = false;
  window.addEventListener("input", () => (typed = true), true);
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
