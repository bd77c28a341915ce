// How wide what lies over the view may be, for the style sheet, in pixels: --wb-timeline-most, and --wb-view-most of what
// begins at the view's right edge, and --wb-timeline-shift from the left edge that viser gives the timeline. It must not
// lie over the controls beside the view. Also how wide the table of envs is when it opens: as its columns need, and the view
// keeps half of the page.
"use strict";
{
  const GAP = 12; // as timeline.py has it
  const NARROWEST = 220; // a panel of viser's
  const BORDER = 4; // beside what is in a docked panel
  const resized = new ResizeObserver(([view]) => {
    const panel = document.querySelector(".wb-timeline")?.closest(".mantine-Paper-root");
    const inView = view.target.getBoundingClientRect();
    // From its left edge: that is where it will be at once, while the view takes some frames to get there. While one
    // page takes the other's place there is no timeline, and the view may not change any more once there is one.
    const given = panel ? parseFloat(panel.style.left) : inView.left + GAP;
    // viser moves a panel that is wider than the view to the view's very edge.
    const shift = Math.max(0, inView.left + GAP - given);
    const most = inView.right - given - shift - GAP;
    const { style } = document.documentElement;
    style.setProperty("--wb-timeline-shift", `${shift}px`);
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

  // viser keeps the width of a panel to itself; it can be dragged.
  let dragging = false;
  function drag(edge, by) {
    const grip = edge.firstElementChild;
    const { x, y } = grip.getBoundingClientRect();
    const at = (kind, target, clientX) =>
      target.dispatchEvent(new PointerEvent(kind, { bubbles: true, button: 0, pointerId: 1, clientX, clientY: y + 1 }));
    dragging = true;
    at("pointerdown", grip, x);
    at("pointermove", window, x + by);
    at("pointerup", window, x + by);
    dragging = false;
  }

  let fitted = ""; // what the table was made as wide as: not again until it is another, or what a person dragged is lost
  function fit() {
    const table = document.querySelector(".wb-env-table");
    const region = table?.closest('[data-dock-region="left"]');
    const edge = region && document.querySelector('[data-dock-region-resize="left"]');
    if (!edge) {
      fitted = "";
      return;
    }
    const of = `${innerWidth} ${table.tHead.rows[0].cells.length}`;
    if (of === fitted || dragging) return;
    fitted = of;
    table.classList.add("wb-measured"); // without the rows that say why: those break
    const needed = table.offsetWidth + 2 * parseFloat(getComputedStyle(table).marginLeft);
    table.classList.remove("wb-measured");
    const beside = document.querySelector('[data-dock-region="right"]')?.offsetWidth ?? 0;
    const wanted = Math.max(NARROWEST, Math.min(Math.ceil(needed) + BORDER, Math.floor(innerWidth / 2) - beside));
    // Not as wide as it is seen: it opens within some frames.
    drag(edge, wanted - parseFloat(region.style.width));
  }
  new MutationObserver(fit).observe(document, { childList: true, subtree: true });
  addEventListener("resize", fit);
}
