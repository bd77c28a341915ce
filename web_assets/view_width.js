// How wide what lies over the view may be, for the style sheet, in pixels: --wb-timeline-most, and --wb-view-most of what
// begins at the view's right edge. It must not lie over the controls beside the view.
"use strict";
{
  const GAP = 12; // as timeline_panel.py has it
  const resized = new ResizeObserver(([view]) => {
    const panel = document.querySelector(".wb-timeline")?.closest(".mantine-Paper-root");
    const inView = view.target.getBoundingClientRect();
    // From its left edge: that is where it will be at once, while the view takes some frames to get there. While one
    // page takes the other's place there is no timeline, and the view may not change any more once there is one.
    const left = panel ? panel.getBoundingClientRect().left : inView.left + GAP;
    const most = inView.right - left - GAP;
    const { style } = document.documentElement;
    style.setProperty("--wb-timeline-most", `${most}px`);
    style.setProperty("--wb-view-most", `${inView.width - 2 * GAP}px`);
  });
  const looked = new MutationObserver(() => {
    const view = document.querySelector("canvas[data-engine]");
    if (!view) return;
    looked.disconnect();
    // Not the canvas itself: it takes its new size some frames after the box that it fills.
    resized.observe(view.parentElement);
  });
  looked.observe(document, { childList: true, subtree: true });
}
