// How wide the table of envs is when it opens: as its columns need, while the view keeps half of the page. viser keeps the
// width of a panel to itself, so its edge is dragged as a person does it; what a person drags afterwards stays.
"use strict";
{
  const NARROWEST = 220; // a panel of viser's
  const BORDER = 4; // beside what is in a docked panel
  let fitted = ""; // the page's width and the number of columns, for which it was done
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
    // Not from the width that is seen: it opens within some frames.
    drag(edge, wanted - parseFloat(region.style.width));
  }
  new MutationObserver(fit).observe(document, { childList: true, subtree: true });
  addEventListener("resize", fit);
}
