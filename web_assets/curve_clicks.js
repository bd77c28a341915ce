// A click on a curve shows its step.
//
// uPlot's chart is not reachable from the page's elements, and what part of the steps it shows changes with its zoom. Its
// legend says the step under the pointer, so that is sent, with the command that the panel names (data-curve). A drag is
// uPlot's zoom.
"use strict";
{
  const STILL = 4; // pixels between the two ends of a click
  const numbers = new Intl.NumberFormat(navigator.language);
  const digits = new Map([...Array(10).keys()].map((digit) => [numbers.format(digit), digit]));
  let down = null;

  // As uPlot writes it: with the language's digits, and separators between thousands.
  function whole(text) {
    const decimal = numbers.formatToParts(1.5).find((part) => part.type === "decimal").value;
    const [before, after] = text.split(decimal);
    const read = [...before].filter((one) => digits.has(one)).map((one) => digits.get(one));
    const half = after && digits.get(after[0]) >= 5 ? 1 : 0;
    return read.length ? (/^[-\u2212]/.test(before.trim()) ? -1 : 1) * Number(read.join("")) + half : null;
  }

  function markOf(element) {
    for (let around = element; around; around = around.parentElement) {
      const mark = around.querySelector("[data-curve]");
      if (mark) return mark;
    }
    return null;
  }

  window.addEventListener(
    "pointerdown",
    (event) => {
      const over = event.target instanceof Element && event.target.closest(".u-over");
      down = over && event.button === 0 ? { over, x: event.clientX, y: event.clientY } : null;
    },
    true,
  );

  window.addEventListener(
    "pointerup",
    (event) => {
      const began = down;
      down = null;
      if (!began || Math.hypot(event.clientX - began.x, event.clientY - began.y) > STILL) return;
      const mark = markOf(began.over);
      const legend = began.over.closest(".uplot")?.querySelector(".u-legend .u-value");
      const step = legend && whole(legend.textContent);
      if (mark && step !== null) wb.ask([mark.dataset.curve, { step }]);
    },
    true,
  );
}
