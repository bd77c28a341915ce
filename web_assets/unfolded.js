// Says to the server that a docked panel has been unfolded.
//
// viser's own buttons fold and unfold a panel in the browser alone, and of what is folded nothing is in the page. Two
// wide panels unfolded beside each other leave no scene on a small screen, and the server, which could fold one for the
// other, would not know. So such a panel has an element in it with the id of a hidden button (`Presses.when_unfolded`), which is
// pressed when the element comes into the page. Likewise a page that draws in software (`drawn_in_software.js`) says so.
"use strict";
{
  const TRIES = 150; // of 200 ms; on a busy machine the button comes long after its element
  const SEEN = "[data-unfolded], [data-drawn-in-software] [data-in-software]";
  const said = new WeakSet();

  function say(element, tries) {
    const button = document.getElementById(element.dataset.unfolded ?? element.dataset.inSoftware);
    if (button) button.click();
    else if (tries > 0 && element.isConnected) setTimeout(() => say(element, tries - 1), 200);
  }

  new MutationObserver(() => {
    for (const element of document.querySelectorAll(SEEN)) {
      if (said.has(element)) continue;
      said.add(element);
      say(element, TRIES);
    }
  }).observe(document, { childList: true, subtree: true });
}
