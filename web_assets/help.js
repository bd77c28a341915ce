// The command of the palette (Ctrl+K) that opens the documents does so in a tab of its own, as the link Help does.
//
// The server cannot: it hears of the press later, and a browser lets a page open a tab only while a press is handled. Enter
// is a click on the entry too.
"use strict";
addEventListener(
  "click",
  (event) => {
    const label = event.target.closest?.(".mantine-Spotlight-action")?.querySelector(".mantine-Spotlight-actionLabel");
    if (label?.textContent === "Help: open the documents") open("/help/", "_blank", "noopener");
  },
  true,
);
