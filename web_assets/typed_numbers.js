// A number is taken when it has been typed: at Enter, Tab, or a press elsewhere.
//
// viser's page sends what a number field holds at each key. Each beginning of a seed was a seed, for which every env was
// reset; of what cannot be a number (letters, 3.7 where whole numbers are asked for) the field kept some digits, and one
// that was emptied stayed so. So what is typed stays in the browser until the hand is off; then it is read as a whole and
// handed on at once, or the field shows again what holds, and says why. Escape does the latter too. Arrows, the small
// buttons and sliders are no typing: they act as before.
"use strict";
{
  const NUMBER = /^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i;
  const LARGEST = 2 ** 53; // up to here a browser counts in ones; control_values.py
  const STAYS = 6000; // milliseconds, as viser's notifications of ours
  const inDom = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value");

  let held = null; // the field that is typed into, what it would show now, and React's own property of it
  let before = "";
  let notice = null;

  const isNumberField = (it) => it instanceof HTMLInputElement && it.classList.contains("mantine-NumberInput-input");

  // React neither sees what is typed nor writes over it (another page has set the number, the panel is drawn anew): to
  // it the field shows what holds.
  function hold(field) {
    held = { field, shows: before, react: Object.getOwnPropertyDescriptor(field, "value") };
    const write = (text) => (held.shows = String(text));
    Object.defineProperty(field, "value", { configurable: true, get: () => held.shows, set: write });
  }

  function release() {
    const { field, shows, react } = held;
    const typed = inDom.get.call(field);
    held = null;
    if (react) Object.defineProperty(field, "value", react);
    else delete field.value;
    field.value = shows; // from here on React knows what stands there
    return { field, typed: typed.trim(), shows };
  }

  // Bounds and digits are nowhere in the page but in React's (Mantine's NumberInput); viser's page is one that we know.
  function boundsOf(field) {
    const key = Object.keys(field).find((name) => name.startsWith("__reactFiber$"));
    const found = {};
    for (let fiber = field[key], up = 0; fiber && up < 40 && !("min" in found); fiber = fiber.return, up++) {
      const props = fiber.memoizedProps ?? {};
      for (const name of ["min", "max", "step", "decimalScale"]) if (name in props) found[name] ??= props[name];
    }
    const { min = -Infinity, max = Infinity, step = 1, decimalScale: digits = 12 } = found;
    return { low: min, high: max, step, digits };
  }

  function whyNot(typed, number, { low, high, digits }) {
    if (typed === "") return "it was left empty";
    if (!NUMBER.test(typed)) return `\u201c${typed.slice(0, 40)}\u201d is not a number`;
    if (digits === 0 && Number.isFinite(number) && !Number.isInteger(number)) return `${number} is not a whole number`;
    if (low <= number && number <= high && Math.abs(number) <= LARGEST) return null;
    if (Number.isFinite(low) && Number.isFinite(high)) return `it goes from ${low} to ${high}`;
    if (number < low) return `it is at least ${low}`;
    return number > high ? `it is at most ${high}` : "so large a number cannot be kept";
  }

  // The field's own label; a field of a timeline has none, and is named beside it.
  function nameOf(field) {
    for (let part = field.parentElement; part; part = part.parentElement) {
      const label = part.querySelector("label");
      if (label?.textContent) return label.textContent;
      const named = part.querySelector("[data-number-name]");
      if (named) return named.dataset.numberName;
    }
    return "Number";
  }

  function say(field, sentence) {
    notice?.remove();
    notice = document.createElement("div");
    notice.className = "wb-not-taken";
    notice.setAttribute("role", "alert");
    notice.textContent = sentence;
    document.body.append(notice);
    const at = field.getBoundingClientRect();
    const below = at.bottom + 4 + notice.offsetHeight <= innerHeight;
    notice.style.top = `${below ? at.bottom + 4 : at.top - 4 - notice.offsetHeight}px`;
    notice.style.left = `${Math.max(4, Math.min(at.left, innerWidth - notice.offsetWidth - 4))}px`;
    const shown = notice;
    setTimeout(() => shown.remove(), STAYS);
  }

  // As if all were selected and this pasted over it. The key is for viser's field (react-number-format): it takes the new
  // text apart by where the caret stood at the last key, and drops it where that does not go with the text before.
  function paste(field, text) {
    field.setSelectionRange(0, field.value.length);
    field.dispatchEvent(new KeyboardEvent("keydown", { key: "Unidentified", bubbles: true }));
    inDom.set.call(field, text);
    field.setSelectionRange(text.length, text.length);
    field.dispatchEvent(new Event("input", { bubbles: true }));
  }

  // With `steps`, one further: React's own step, a moment after this, would still be from the number before.
  function take(steps = 0) {
    const { field, typed, shows } = release();
    if (!field.isConnected || (typed === shows && !steps)) return;
    const bounds = boundsOf(field);
    let number = Number(typed);
    const why = whyNot(typed, number, bounds);
    if (why) return say(field, `${nameOf(field)}: ${why}. It stays ${shows || "as it was"}.`);
    if (steps) number = Math.max(bounds.low, Math.min(bounds.high, number + steps * bounds.step));
    // In plain digits: of an exponent viser's field would keep the figures. Adding 0 makes -0 a 0.
    const digits = Math.min(bounds.digits, 20);
    paste(field, (number + 0).toFixed(digits).replace(/(\.\d*?)0+$/, "$1").replace(/\.$/, ""));
  }

  function takeAStepFurther(event, steps) {
    event.preventDefault();
    event.stopImmediatePropagation();
    take(steps);
  }

  const listen = (kind, does) => window.addEventListener(kind, does, true);

  for (const kind of ["focusin", "beforeinput"])
    listen(kind, (event) => {
      if (held?.field !== event.target && isNumberField(event.target)) before = event.target.value;
    });
  listen("input", (event) => {
    if (!event.isTrusted || !isNumberField(event.target)) return; // what our own scripts type is whole
    if (held && held.field !== event.target) take();
    if (!held) hold(event.target);
    notice?.remove();
    event.stopImmediatePropagation();
  });
  // React hears this one too; a browser sends it at Enter, and before the focus goes.
  listen("change", (event) => {
    if (held?.field !== event.target) return;
    event.stopImmediatePropagation();
    take();
  });
  listen("keydown", (event) => {
    if (held?.field !== event.target) return;
    const steps = { ArrowUp: 1, ArrowDown: -1 }[event.key];
    if (event.key === "Escape") release();
    else if (event.key === "Enter") take();
    else if (steps) takeAStepFurther(event, steps);
  });
  listen("pointerdown", (event) => {
    if (!held || held.field === event.target) return;
    const button = event.target.closest?.(".mantine-NumberInput-control");
    if (!button || !held.field.parentElement.contains(button)) return take();
    takeAStepFurther(event, button.dataset.direction === "up" ? 1 : -1);
  });
  listen("focusout", (event) => held?.field === event.target && take());
}
