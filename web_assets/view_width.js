// How wide the 3-D view is, for the style sheet: --wb-view-width, in pixels.
//
// What lies over the view must not lie over the controls beside it. The server fits it when a page has said how wide
// its view has become; while a docked panel is opened that is some frames too late, and the controls are covered.
"use strict";
{
  const told = new ResizeObserver(([view]) =>
    document.documentElement.style.setProperty("--wb-view-width", `${view.contentRect.width}px`),
  );
  const looked = new MutationObserver(() => {
    const view = document.querySelector("canvas[data-engine]");
    if (!view) return;
    looked.disconnect();
    // Not the canvas itself: it takes its new size some frames after the box that it fills.
    told.observe(view.parentElement);
  });
  looked.observe(document, { childList: true, subtree: true });
}
