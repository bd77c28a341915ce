// What was typed arrives before the Enter that ends it.
//
// viser's page sends one message every 50 ms, and of those that are to be sent in between only the last
// (WebsocketUtils.ts). Enter is a message like a letter: pressed at once after one, it took the letter's place, and what
// was kept lacked the last letters. So Enter in a form waits until the letters are on their way.
"use strict";
{
  const SENT_WITHIN = 60; // milliseconds; a little more than viser takes
  let typedAt = -Infinity;
  window.addEventListener("input", () => (typedAt = performance.now()), true);
  // On the window and first: viser hears it after this.
  window.addEventListener(
    "submit",
    (event) => {
      const form = event.target;
      const left = typedAt + SENT_WITHIN - performance.now();
      if (left <= 0) return;
      event.preventDefault();
      event.stopImmediatePropagation();
      setTimeout(() => form.isConnected && form.requestSubmit(), left);
    },
    true,
  );
}
