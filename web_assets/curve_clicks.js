// A click on a curve sends the panel's command (data-curve) with the step at the pointer. A drag is uPlot's zoom.
//
// The page's elements give no access to the chart object, and after a zoom only the chart knows its range of steps. Its legend
// shows the step under the pointer, with the digits of the browser's language. Feature to request from viser: a click event of
// a chart, with its x.
"use strict";
{
  const STILL = 4; // maximum pixels between pointer down and up of a click
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
