// Sets CSS variables, in pixels, for elements over the view: --wb-timeline-most, maximum width of the timeline;
// --wb-timeline-shift, its offset from where viser puts it; --wb-view-right, the view's right edge; --wb-view-most, maximum
// width of elements that begin there. The timeline must not cover the controls next to the view.
"use strict";
{
  const GAP = 12; // GAP_PIXELS in timeline_panel.py
  let view = null;
  let panel = null;

  function tell() {
    const inView = view.getBoundingClientRect();
    // The panel's final position, which the view reaches some frames later. While one page replaces the other there is no
    // timeline, and the view may not change again once there is one.
    const given = panel?.isConnected ? parseFloat(panel.style.left) : inView.left + GAP;
    // viser puts a panel that is wider than the view at the view's edge, without the gap.
    const shift = Math.max(0, inView.left + GAP - given);
    const { style } = document.documentElement;
    style.setProperty("--wb-timeline-shift", `${shift}px`);
    style.setProperty("--wb-timeline-most", `${inView.right - given - shift - GAP}px`);
    style.setProperty("--wb-view-right", `${inView.right}px`);
    style.setProperty("--wb-view-most", `${inView.width - 2 * GAP}px`);
  }
  const resized = new ResizeObserver(tell);
  const moved = new MutationObserver(tell); // also after the view has its size
  new MutationObserver(() => {
    const canvas = document.querySelector("canvas[data-engine]");
    // Not the canvas itself: it gets its new size some frames after its container.
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
