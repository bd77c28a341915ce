// A click on a curve shows its step: does the command that the panel names (data-curve). A drag is uPlot's zoom.
//
// The chart cannot be reached from the page's elements, and after a zoom only it knows what part of the steps it shows. Its legend says the
// step under the pointer, with the digits of the browser's language. To ask viser for: a click on a chart, with its x.
"use strict";
{
  const STILL = 4; // pixels between the two ends of a click
  const numbers = new Intl.NumberFormat(navigator.language, { useGrouping: false });
  const digits = [...numbers.format(9876543210)].reverse();
  const decimal = numbers.formatToParts(0.5).find(({ type }) => type === "decimal").value;
  let down = null;

  const read = (text = "") => [...text].map((one) => digits.indexOf(one)).filter((digit) => digit >= 0).join("");
  function stepOf(text) {
    const [whole, part] = text.split(decimal);
    return read(whole) && Math.round(Number(`${/^[\s\p{Cf}]*[-\u2212]/u.test(text) ? "-" : ""}${read(whole)}.${read(part)}`));
  }

  addEventListener("pointerdown", ({ target, button, clientX: x, clientY: y }) => {
    const over = button === 0 && target.closest?.(".u-over");
    down = over && { over, x, y };
  }, true);
  addEventListener("pointerup", ({ clientX, clientY }) => {
    if (!down || Math.hypot(clientX - down.x, clientY - down.y) > STILL) return;
    const panel = down.over.closest(":has([data-curve])")?.querySelector("[data-curve]");
    const step = stepOf(down.over.closest(".uplot")?.querySelector(".u-legend .u-value")?.textContent ?? "");
    if (panel && step !== "") wb.ask([panel.dataset.curve, { step }]);
  }, true);
}
