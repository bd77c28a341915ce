// How wide what lies over the view may be, for the style sheet, in pixels: --wb-timeline-most, and --wb-view-most of what
// begins at the view's right edge, --wb-view-right; and --wb-timeline-shift, from where viser puts the timeline. It must not
// lie over the controls beside the view.
"use strict";
{
  const GAP = 12; // as timeline.py has it
  let view = null;
  let panel = null;

  function tell() {
    const inView = view.getBoundingClientRect();
    // Where the panel will be at once, while the view takes some frames to get there. While one page takes the other's
    // place there is no timeline, and the view may not change any more once there is one.
    const given = panel?.isConnected ? parseFloat(panel.style.left) : inView.left + GAP;
    // viser puts a panel that is wider than the view at the view's very edge.
    const shift = Math.max(0, inView.left + GAP - given);
    const { style } = document.documentElement;
    style.setProperty("--wb-timeline-shift", `${shift}px`);
    style.setProperty("--wb-timeline-most", `${inView.right - given - shift - GAP}px`);
    style.setProperty("--wb-view-right", `${inView.right}px`);
    style.setProperty("--wb-view-most", `${inView.width - 2 * GAP}px`);
  }
  const resized = new ResizeObserver(tell);
  const moved = new MutationObserver(tell); // after the view has its size, too
  new MutationObserver(() => {
    const canvas = document.querySelector("canvas[data-engine]");
    // Not the canvas itself: it takes its new size some frames after the box that it fills.
    if (canvas && canvas.parentElement !== view) {
      resized.disconnect();
      view = canvas.parentElement;
      resized.observe(view);
    }
    const there = document.querySelector(".wb-timeline")?.closest(".mantine-Paper-root");
    if (view && there && there !== panel) {
      moved.disconnect();
      panel = there;
      moved.observe(panel, { attributeFilter: ["style"] });
      tell();
    }
  }).observe(document, { childList: true, subtree: true });
}
