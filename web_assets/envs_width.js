// How wide the table of envs is when it opens: as its columns need, while the view keeps half of the page. viser keeps the
// width of a panel to itself, so its edge is dragged as a person does it; what a person drags afterwards stays. Where the
// columns find no room, first the words beside the dots and then whole columns give way (data-gives-way, the lowest first).
"use strict";
{
  const NARROWEST = 220; // a panel of viser's
  const BORDER = 4; // beside what is in a docked panel
  const sheet = document.head.appendChild(document.createElement("style"));
  let seen = null; // the table that was fitted: viser makes another whenever a number changes
  let fitted = ""; // the page's width and the columns, for which the panel got its width
  let given = 0; // that width
  let shown = ""; // the room and the columns, for which some were left out
  let hidden = [];
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

  // Without the rows that say why: those break.
  function measured(table, as) {
    table.classList.add("wb-measured");
    table.style.width = as;
    const width = table.offsetWidth;
    table.style.width = "";
    table.classList.remove("wb-measured");
    return width;
  }

  function leaveOut(table, room) {
    const head = [...table.tHead.rows[0].cells];
    const inTurn = head.filter((cell) => cell.dataset.givesWay).sort((a, b) => a.dataset.givesWay - b.dataset.givesWay);
    hidden = [];
    sheet.textContent = "";
    if (measured(table, "min-content") > room) sheet.textContent = ".wb-env-table .wb-word { display: none }";
    if (measured(table, "min-content") > room) sheet.textContent += ".wb-env-table :is(th, td) { padding-right: 0.45em !important }";
    while (inTurn.length && measured(table, "min-content") > room) {
      const cell = inTurn.shift();
      hidden.push(cell.dataset.name);
      sheet.textContent += `.wb-env-table tr:not(.wb-why) > :nth-child(${cell.cellIndex + 1}) { display: none }`;
    }
  }

  function fit() {
    const table = document.querySelector(".wb-env-table");
    const region = table?.closest('[data-dock-region="left"]');
    const edge = region && document.querySelector('[data-dock-region-resize="left"]');
    if (!edge) {
      fitted = "";
      seen = null;
      return;
    }
    if (dragging) return;
    const columns = [...table.tHead.rows[0].cells].map((cell) => `${cell.dataset.name} ${cell.dataset.givesWay}`).join();
    const margins = 2 * parseFloat(getComputedStyle(table).marginLeft);
    const isWide = () => parseFloat(region.style.width); // not the width that is seen: it opens within some frames
    if (table !== seen || fitted !== `${innerWidth} ${columns}`) {
      sheet.disabled = true;
      const needed = Math.ceil(measured(table, "max-content") + margins) + BORDER;
      sheet.disabled = false;
      const beside = document.querySelector('[data-dock-region="right"]')?.offsetWidth ?? 0;
      const wanted = Math.max(NARROWEST, Math.min(needed, Math.floor(innerWidth / 2) - beside));
      // Numbers grow; the panel follows while nobody has given it another width.
      if (fitted !== `${innerWidth} ${columns}` || (wanted > given && Math.abs(isWide() - given) < 1)) {
        drag(edge, wanted - isWide());
        given = wanted;
      }
      fitted = `${innerWidth} ${columns}`;
    }
    const room = Math.floor(isWide() - BORDER - margins);
    if (shown !== `${room} ${columns}` || (table !== seen && measured(table, "min-content") > room)) {
      leaveOut(table, room);
      shown = `${room} ${columns}`;
    }
    const note = table.parentElement.querySelector(".wb-envs-hidden");
    if (table !== seen || note.dataset.hidden !== hidden.join()) {
      note.dataset.hidden = hidden.join();
      note.textContent = hidden.length ? `${hidden.length} hidden` : "";
      note.title = hidden.length ? `No room for the columns ${hidden.join(", ")}. Drag the panel's edge to see them.` : "";
    }
    if (table !== seen) resized.observe(region); // a person drags its edge
    seen = table;
  }
  const resized = new ResizeObserver(fit);
  new MutationObserver(fit).observe(document, { childList: true, subtree: true });
  addEventListener("resize", fit);
}
