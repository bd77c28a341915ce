// Sends the user's input as numbered commands over one WebSocket, in order. The server replies to each.
//
//   data-page="x7Hq"                         this page's name, assigned by the server
//   data-keys='[["s","live","step",true]]'   keys: key, context, command, whether a held key repeats it;
//                                            data-contexts: contexts whose keys always work
//   data-context="library"                   while this element is in the page, the keys of that context work
//   data-do='["select_env", {"env": 3}]'     command of a press
//     data-held="held"                         the command's field for the modifier keys: "", "ctrl", "shift", "ctrl+shift"
//     data-twice='["open_row", {...}]'         command of a double press
//     data-place                               the command's fields x and y: the position in the element, 0 to 1 from the upper left
//     data-along='["step", 0, 99]'             the command's field for the position along the element: an integer from 0 to 99
//   data-hover='["hover_body", {"body": "cube"}]'  command while the pointer is on this element; then again with empty fields
//   data-copy="text"                         a press copies this text
//   data-tell='["tell_unfolded", {...}]'     command sent when the element is added (data-only="x": only if <html> has data-x)
//   data-seen='["tell_unfolded", {...}]'     command sent when the element first comes into sight
//   data-into-sight                          scroll the parent into view when added; data-follow="7": the library's row 7
//   data-title="PushCube"                    title of the browser's tab; without one the last title stays
//   data-field='["set_seed", {}, "seed"]'    command, its other fields, and the field for the value: committed on Enter or blur, when an
//                                            option is chosen, or (data-live) on every input; Enter sends data-enter
//     data-done="set_joint"                    command, with the same fields, for the value at the end of a slider's drag
//     data-number="[0, null, 1, true]"         a number: minimum, maximum, step of an arrow key, whether it is an integer
//   data-drive='["drive_robot", "keys", ["w"], "axes", "buttons", {"3": "keep_episode"}]'  while this element is in the page, these keys drive: the
//                                            command's field has the held ones, sent when they change and every 100 ms; the last
//                                            two fields have the deflections of a gamepad, sent every 50 ms while one is held;
//                                            the commands by button are sent when that button is pressed.
//                                            <html> has data-gamepad while the browser reports a gamepad of the standard layout
//   data-search="text.look..."               a list that the field of this name searches: letters go into the field, arrow keys from it
//                                            into the list, starting at data-best
//   data-shows='[["text.set_seed.seed", "12", false, {}]]'  name of a data-field element; the server's value, copied into the element
//                                            while it is not in use; whether it is disabled; new options ([label, value]) or bounds
"use strict";
{
  const STILL = 6; // maximum pixels that a press may move
  const TWICE = 450; // maximum milliseconds between the presses of a double press
  const NOTICE = 8000; // milliseconds
  const DRAWN = 1000; // milliseconds within which the server redraws an entered value
  const OPENING = 10000; // milliseconds within which a window opens; a slow browser needs seconds for its first frames
  const AWAY = 1500; // milliseconds without a connection before the notice is shown

  // --- the channel ------------------------------------------------------------------------------------------------------

  let socket = null;
  let page = "";
  let sent = 0;
  const unanswered = new Map(); // message number -> data-field of the input, or data-do of the dragged element; else empty
  const newest = new Map(); // the same data-field or data-do -> the newest command; it waits for the reply to the previous one
  const early = []; // messages from before the socket was open

  let notice = null;
  function tell(text, beside = null) {
    notice?.remove();
    const shown = (notice = document.createElement("div"));
    notice.className = "wb-not-taken";
    notice.setAttribute("role", "alert");
    notice.textContent = text;
    document.body.append(notice);
    const { left, bottom } = beside?.getBoundingClientRect() ?? { left: innerWidth / 2 - notice.offsetWidth / 2, bottom: 40 };
    notice.style.left = `${Math.max(4, Math.min(left, innerWidth - notice.offsetWidth - 4))}px`;
    notice.style.top = `${Math.min(bottom + 4, innerHeight - notice.offsetHeight - 4)}px`;
    setTimeout(() => shown.remove(), NOTICE);
  }

  function send(command, of = "") {
    const message = JSON.stringify({ n: ++sent, do: command });
    if (socket?.readyState === WebSocket.OPEN) socket.send(message);
    else if (!socket || socket.readyState === WebSocket.CONNECTING) early.push(message);
    else return tell("Not done: there is no connection.");
    unanswered.set(sent, of);
  }

  const isUnanswered = (of) => [...unanswered.values()].includes(of);

  // For a field or a drag, queue only the newest value while a reply is pending.
  function sendNewest(of, command) {
    if (isUnanswered(of)) newest.set(of, command);
    else send(command, of);
  }

  // Values entered before a command are sent before it.
  function ask(command) {
    for (const [of, value] of newest) send(value, of);
    newest.clear();
    send(command);
  }

  function answered({ n, refused }) {
    const of = unanswered.get(n);
    unanswered.delete(n);
    if (of && newest.has(of) && !isUnanswered(of)) {
      send(newest.get(of), of);
      newest.delete(of);
    }
    if (of && !isUnanswered(of)) keepEntered(of, refused);
    if (refused) opening = 0;
    if (refused && of) showValues(of);
    showValues();
  }

  function connect() {
    if (socket) {
      socket.onclose = null;
      socket.close();
      lost();
    }
    const opened = Date.now();
    let refused = true;
    const mine = new WebSocket(`${location.origin.replace("http", "ws")}/do?${new URLSearchParams({ page, width: innerWidth })}`);
    socket = mine;
    mine.onopen = () => {
      refused = false;
      clearTimeout(away);
      away = 0;
      gone?.remove();
      early.splice(0).forEach((message) => mine.send(message));
    };
    mine.onmessage = ({ data }) => answered(JSON.parse(data));
    mine.onclose = () => {
      lost();
      away ||= setTimeout(tellGone, AWAY);
      if (refused) reloadIfShutOut();
      setTimeout(() => socket === mine && connect(), Math.max(200, opened + 1000 - Date.now()));
    };
  }

  let away = 0; // timer of the notice
  let gone = null; // the notice
  function tellGone() {
    gone = document.createElement("div");
    gone.className = "wb-server-gone";
    gone.setAttribute("role", "alert");
    const what = document.createElement("b");
    what.textContent = `No answer from the workbench at ${location.host}.`;
    gone.append(
      what,
      " The page shows the last state that it received; commands are not possible. If the workbench still runs in its terminal, check the connection (network, ssh). If it has ended, start it again and open the address that it prints. This page continues as soon as it answers.",
    );
    document.body.append(gone);
  }

  // After the token was renewed the server refuses the connection. A reload shows its refusal page, which says what to do.
  async function reloadIfShutOut() {
    const reply = await fetch("/workbench/logo.svg", { cache: "no-store" }).catch(() => null);
    if (reply?.status === 403) location.reload();
  }

  // Commands without a reply may have been carried out or not. They are not retried: minutes later that would be a surprise.
  function lost() {
    if (unanswered.size) tell("The connection was lost: the last command may not have been carried out.");
    unanswered.clear();
    newest.clear();
    entered.clear();
    early.splice(0);
  }

  // --- presses ----------------------------------------------------------------------------------------------------------

  const part = (event, what) => (event.target instanceof Element ? event.target.closest(`[${what}]`) : null);
  const heldOf = ({ ctrlKey, metaKey, shiftKey }) => [(ctrlKey || metaKey) && "ctrl", shiftKey && "shift"].filter(Boolean).join("+");
  const within = (at, from, size) => Math.min(1, Math.max(0, (at - from) / Math.max(size, 1)));

  // The command of an element, with fields from the event.
  function commandOf(element, event) {
    const [name, fields] = JSON.parse(element.dataset.do);
    const said = { ...fields };
    if (element.dataset.held) said[element.dataset.held] = heldOf(event);
    return [name, said];
  }

  // Returns a function from the pointer's position to the command. The element is read only now: the next redraw replaces it.
  function commandAt(element) {
    const [name, fields] = JSON.parse(element.dataset.do);
    const { left, top, width, height } = element.getBoundingClientRect();
    const [field, low, high] = JSON.parse(element.dataset.along ?? "[]");
    return ({ clientX, clientY }) => {
      const [x, y] = [within(clientX, left, width), within(clientY, top, height)];
      return [name, { ...fields, ...(field ? { [field]: Math.round(low + x * (high - low)) } : { x, y }) }];
    };
  }

  // A redraw may replace or move an element between pointer down and up, and then the browser sends no click. So a press applies
  // to the element at pointer down, and counts if the pointer hardly moved or is still on an element with the same command.
  let pressed = null; // { does, command, twice, held, x, y }
  let dragged = null; // { of, at } of the dragged element
  let last = { does: "", at: 0 };

  addEventListener(
    "pointerdown",
    (event) => {
      pressed = dragged = null;
      const element = part(event, "data-do");
      if (!element || !event.isPrimary || event.button !== 0) return;
      if ("place" in element.dataset || element.dataset.along) {
        dragged = { of: element.dataset.do, at: commandAt(element) };
        sendNewest(dragged.of, dragged.at(event));
        event.preventDefault();
        return;
      }
      const { clientX: x, clientY: y } = event;
      const { do: does, twice } = element.dataset;
      pressed = { does, command: commandOf(element, event), twice, held: heldOf(event), x, y };
    },
    true,
  );
  addEventListener("pointermove", (event) => {
    if (dragged) sendNewest(dragged.of, dragged.at(event));
  }, true);
  addEventListener("pointercancel", () => (pressed = dragged = null), true);
  addEventListener(
    "pointerup",
    (event) => {
      const it = pressed;
      pressed = dragged = null;
      if (!it) return;
      const still = Math.hypot(event.clientX - it.x, event.clientY - it.y) < STILL;
      if (!still && part(event, "data-do")?.dataset.do !== it.does) return;
      const again = it.twice && !it.held && last.does === it.does && performance.now() - last.at < TWICE;
      last = { does: again || it.held ? "" : it.does, at: performance.now() };
      ask(again ? JSON.parse(it.twice) : it.command);
    },
    true,
  );
  // Without a pointer: a screen reader, voice control, Enter and Space on a button.
  addEventListener("click", (event) => {
    const element = part(event, "data-do");
    if (element && event.detail === 0) ask(commandOf(element, event));
    const from = part(event, "data-copy");
    if (!from) return;
    if (!navigator.clipboard) return prompt("Copy with Ctrl+C", from.dataset.copy);
    navigator.clipboard.writeText(from.dataset.copy);
    from.textContent = "copied";
  }, true);

  let hovered = ""; // data-hover of the element under the pointer
  addEventListener("pointerover", (event) => {
    const now = part(event, "data-hover")?.dataset.hover ?? "";
    if (now === hovered) return;
    const [name, fields] = JSON.parse(now || hovered);
    hovered = now;
    sendNewest("hover", [name, now ? fields : Object.fromEntries(Object.keys(fields).map((field) => [field, ""]))]);
  }, true);

  // --- keys -------------------------------------------------------------------------------------------------------------

  const TYPED = "input:not([type=checkbox], [type=radio], [type=range], [type=button]), textarea, select, [contenteditable]:not([contenteditable=false])";
  const CLOSED = CSS.supports("selector(:open)") ? "select:not(:open)" : ":not(*)";
  const TYPED_INTO = "input[type=text], textarea";
  const CONTROL = "button, a[href], input, select, summary, [role=slider], [role=tab], [role=menuitem], [role=option], [role=button]";
  const MOVES = /^(Enter| |Arrow.*|Home|End|Page.*)$/;
  const NAMES = { " ": "space" };
  const OPENS = /^ctrl\+(k|o|shift\+p)$/; // keys of the palette and of the list of tasks
  let opening = 0; // time until which a window may open; keys typed meanwhile are meant for it and trigger nothing here
  let typedEarly = ""; // what was typed meanwhile
  const PRESSED = "[data-do], [data-copy], [data-fold]";
  let keys = []; // [key, context, command, repeats]; kept while a folded panel removes them from the page
  let always = [];
  let keyList = null; // the list of keys to show

  function readKeys() {
    const shown = [...document.querySelectorAll("[data-keys]")].at(-1);
    if (!shown) return;
    keyList = shown;
    keys = JSON.parse(shown.dataset.keys);
    always = shown.dataset.contexts.split(" ");
  }

  // CapsLock changes `key`, and a Cyrillic layout has no "s": use the letter of the physical key.
  function nameOf({ key, code, ctrlKey, metaKey, altKey, shiftKey }) {
    const letter = /^\p{L}$/u.test(key);
    const name = NAMES[key] ?? (letter && !/^[a-z]$/i.test(key) ? code.replace("Key", "") : key);
    const held = [(ctrlKey || metaKey) && "ctrl", altKey && "alt", shiftKey && (letter || name.length > 1) && "shift"];
    return [...held.filter(Boolean), name.toLowerCase()].join("+");
  }

  // While a dialog is open, only the contexts in it count.
  function contexts() {
    const dialog = [...document.querySelectorAll("[aria-modal=true], dialog[open], body > .wb-all-keys:popover-open")].at(-1);
    const there = [...(dialog ?? document).querySelectorAll("[data-context]")].map((one) => one.dataset.context);
    return dialog ? there : [...there.reverse(), ...always];
  }

  function keyed(event) {
    readKeys();
    const name = nameOf(event);
    const on = contexts();
    const found = keys.filter(([key, context]) => key === name && on.includes(context));
    return found.sort((a, b) => on.indexOf(a[1]) - on.indexOf(b[1]))[0];
  }

  // viser opens the palette unless an input has the focus; the server opens the list of tasks.
  function opens(event) {
    const name = nameOf(event);
    return OPENS.test(name) && (name === "ctrl+o" ? keyed(event) : !document.activeElement?.matches("input, textarea, select"));
  }

  // The field of the opened window gets what was typed before it had the focus. Later: the field may still be selecting its text.
  addEventListener("focusin", ({ target }) => {
    if (!target.closest?.(TYPED) || performance.now() >= opening) return;
    opening = 0;
    queueMicrotask(() => typedEarly && document.execCommand("insertText", false, typedEarly));
  }, true);
  addEventListener("pointerdown", () => (opening = 0), true);

  // Shows a copy of the list: a redraw may remove the original.
  function toggleKeyList() {
    const shown = document.querySelector("body > .wb-all-keys:popover-open");
    if (shown || !keyList) return shown?.hidePopover();
    const list = document.body.appendChild(keyList.cloneNode(true));
    list.removeAttribute("data-keys");
    list.addEventListener("toggle", ({ newState }) => newState === "closed" && list.remove());
    list.showPopover();
  }

  // viser moves its view with these keys and cannot be told not to: S would step and also move the view. Its listener on the
  // document runs after this one.
  const MOVE_VIEW = /^(Key[WASDQE]|Arrow(Up|Down|Left|Right))$/; // viser 1.1, CameraControls.tsx
  document.addEventListener("keydown", (event) => MOVE_VIEW.test(event.code) && event.stopImmediatePropagation());

  const BEAT = 100; // milliseconds between reports of held keys; the server lets go without them
  const held = new Set();
  let beat = 0;

  // The physical key, so that CapsLock, Shift and another layout drive too.
  const drivingKey = ({ code, key }) => (code.startsWith("Key") ? code.slice(3) : key).toLowerCase();

  function reportHeld() {
    const drive = document.querySelector("[data-drive]")?.dataset.drive;
    if (!drive) held.clear();
    else {
      const [name, field, , axes, buttons] = JSON.parse(drive);
      sendNewest("drive", [name, { [field]: [...held], [axes]: pad?.axes ?? [], [buttons]: pad?.buttons ?? [] }]);
    }
    if (held.size) beat ||= setInterval(reportHeld, BEAT);
    else beat = clearInterval(beat);
  }

  function drives(event) {
    const drive = document.querySelector("[data-drive]")?.dataset.drive;
    const key = drivingKey(event);
    if (!drive || event.ctrlKey || event.metaKey || event.altKey || !JSON.parse(drive)[2].includes(key)) return false;
    if (!event.repeat) {
      held.add(key);
      reportHeld();
    }
    return true;
  }

  const PAD_BEAT = 50; // milliseconds between readings of the gamepad
  const REST = 0.1; // deflection up to which a stick or button counts as released
  const PRESSED_BY = 0.5; // deflection from which a button counts as pressed
  let pad = null; // deflections while one is held
  let padBeat = 0;

  function readPad() {
    const driving = document.querySelector("[data-drive]");
    const found = driving && [...(navigator.getGamepads?.() ?? [])].find((one) => one?.connected && one.mapping === "standard");
    document.documentElement.toggleAttribute("data-gamepad", Boolean(found));
    const was = pad;
    const rounded = (value) => Math.round(1000 * Math.max(-1, Math.min(1, value))) / 1000;
    const axes = (found?.axes ?? []).slice(0, 4).map(rounded);
    const buttons = (found?.buttons ?? []).slice(0, 17).map((button) => rounded(button.value));
    // Another window may be in front: what is held there is not meant for the robot.
    const isHeld = document.hasFocus() && [...axes, ...buttons].some((value) => Math.abs(value) > REST);
    pad = isHeld ? { axes, buttons } : null;
    const presses = pad ? JSON.parse(driving.dataset.drive)[5] : {};
    for (const [button, command] of Object.entries(presses)) {
      if (pad.buttons[button] > PRESSED_BY && !(was?.buttons[button] > PRESSED_BY)) send([command, {}]);
    }
    if (pad || was) reportHeld();
    if (!driving) padBeat = clearInterval(padBeat);
  }

  addEventListener("keyup", (event) => held.delete(drivingKey(event)) && reportHeld(), true);
  addEventListener("blur", () => {
    if (!held.size) return;
    held.clear();
    reportHeld();
  });

  addEventListener(
    "keydown",
    (event) => {
      if (event.isComposing || event.keyCode === 229) return;
      // A select that was opened by the pointer and closed again would use letters to choose options.
      if (byPointer && event.target.matches?.(CLOSED)) event.target.blur();
      byPointer = false;
      const at = document.activeElement ?? document.body;
      if (event.key === "Escape" || at.closest(TYPED)) opening = 0;
      else if (opens(event)) [opening, typedEarly] = [performance.now() + OPENING, performance.now() < opening ? typedEarly : ""];
      else if (performance.now() < opening && !event.ctrlKey && !event.metaKey && !event.altKey) {
        if (event.key.length === 1) typedEarly += event.key;
        if (event.key === "Backspace") typedEarly = typedEarly.slice(0, -1);
        event.preventDefault();
        event.stopImmediatePropagation();
        return;
      }
      if (!at.closest(TYPED) && !contexts().includes("dialog") && drives(event)) {
        event.preventDefault();
        event.stopImmediatePropagation();
        return;
      }
      const does = at.closest(PRESSED);
      if (!event.defaultPrevented && (event.key === "Enter" || event.key === " ") && does?.contains(event.target) && !at.closest(TYPED)) {
        if (does.dataset.do && !event.repeat) ask(commandOf(does, event));
        else if (!event.repeat) does.click();
        event.preventDefault();
        event.stopImmediatePropagation();
        return;
      }
      const list = STEPS[event.key] && !heldOf(event) && does?.closest("[data-roving]");
      if (list || searches(event, at)) {
        if (list) walk(list, does, event.key);
        event.preventDefault();
        event.stopImmediatePropagation();
        return;
      }
      const one = { ArrowUp: 1, ArrowDown: -1 }[event.key];
      if (one && event.target.dataset?.number) {
        stepNumber(event.target, one);
        event.preventDefault();
        return;
      }
      const found = keyed(event);
      // A text field gets all keys, except Escape in a dialog; a focused control gets the keys that move it.
      const typing = document.activeElement?.closest(TYPED) && !(event.key === "Escape" && at.closest("[aria-modal=true]"));
      if (typing || (MOVES.test(event.key) && !event.altKey && at.closest(CONTROL))) return;
      if (event.key === "?") toggleKeyList();
      if (!found) return;
      const [, , command, repeats] = found;
      if (!event.repeat || repeats) ask([command, {}]);
      event.preventDefault();
      event.stopImmediatePropagation();
    },
    true,
  );

  // In a table or on a strip, Tab stops at one part and the arrow keys move to the others; among cards, up and down move to the
  // card above and below.
  const STEPS = { ArrowLeft: -1, ArrowUp: -1, ArrowRight: 1, ArrowDown: 1 };
  function walk(list, from, key) {
    const parts = [...list.querySelectorAll("[tabindex][data-do]")];
    const [step, at, here] = [STEPS[key], parts.indexOf(from), from.getBoundingClientRect()];
    const next = step > 0 ? parts.slice(at + 1) : parts.slice(0, at).reverse();
    const isThere = (part) => {
      const { left, right, top } = part.getBoundingClientRect();
      return step > 0 ? top > here.top + 4 && right > here.left + 4 : top < here.top - 4 && left <= here.left + 4;
    };
    ((/Up|Down/.test(key) && next.find(isThere)) || next[0])?.focus();
  }

  // Returns whether the key is fully handled. A letter is not: it goes into the field, which has the focus by then.
  function searches(event, at) {
    const list = [...document.querySelectorAll("[data-search]")].at(-1);
    const dialog = [...document.querySelectorAll("[aria-modal=true]")].at(-1);
    const field = list && (!dialog || dialog.contains(list)) && [...document.getElementsByName(list.dataset.search)].at(-1);
    if (!field || event.ctrlKey || event.metaKey || event.altKey) return false;
    const best = list.querySelector("[data-best]");
    if (at === field && event.key === "Escape" && field.value && dialog) {
      field.value = "";
      typed(field);
      return true;
    }
    if (at === field && best && STEPS[event.key] && (/Up|Down/.test(event.key) || !field.value)) {
      walk(list, best, event.key);
      return true;
    }
    if (event.key.length === 1 && (at === document.body || list.contains(at))) {
      field.focus();
      event.stopImmediatePropagation();
    }
    return false;
  }

  // --- fields -----------------------------------------------------------------------------------------------------------

  const NUMBER = /^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i;
  function whyNot(text, [low, high, , whole]) {
    const number = Number(text);
    if (text === "") return "it was left empty";
    if (!NUMBER.test(text)) return `\u201c${text.slice(0, 40)}\u201d is not a number`;
    if (whole && Number.isFinite(number) && !Number.isInteger(number)) return `${number} is not a whole number`;
    if (Number.isFinite(number) && (low ?? number) <= number && number <= (high ?? number)) return "";
    if (low === null && high === null) return "it is too large";
    if (high === null) return `it must be at least ${low}`;
    return low === null ? `it must be at most ${high}` : `it must be from ${low} to ${high}`;
  }

  // The value of an input for its command; undefined if it is not a valid number.
  function valueOf(input) {
    if (input.type === "checkbox") return input.checked;
    if (input.tagName === "SELECT") return JSON.parse(input.value);
    if (input.type === "range") return Number(input.value);
    if (!input.dataset.number) return input.value;
    const why = whyNot(input.value.trim(), JSON.parse(input.dataset.number));
    if (!why) return Number(input.value);
    showValues("", input);
    tell(`${input.ariaLabel}: ${why}. It stays ${input.value}.`, input);
  }

  // Between the reply and the next drawing the page has the server's old value: without this an input would jump back to it.
  const entered = new Map(); // data-field -> [shown value, time until which it stays]

  function typed(input, isLive = false) {
    const of = input.dataset.field;
    const [live, fields, field] = JSON.parse(of);
    const name = (!isLive && input.dataset.done) || live;
    edited.delete(input);
    const value = valueOf(input);
    if (value === undefined) return;
    entered.set(of, [input.tagName === "SELECT" ? input.value : String(value), Infinity]);
    sendNewest(of, [name, { ...fields, [field]: value }]);
  }

  function keepEntered(of, refused) {
    if (!entered.has(of)) return;
    if (refused) return entered.delete(of);
    entered.get(of)[1] = performance.now() + DRAWN;
    setTimeout(showValues, DRAWN + 50);
  }

  // Change a number by steps, within its bounds.
  function stepNumber(input, steps) {
    const [low, high, step] = JSON.parse(input.dataset.number);
    const next = Number(((Number(input.value) || 0) + steps * step).toPrecision(12));
    input.value = Math.max(low ?? next, Math.min(high ?? next, next));
    typed(input);
  }
  const edited = new WeakSet(); // inputs with unsent text
  addEventListener("input", ({ target }) => {
    if (!target.dataset?.field) return;
    edited.add(target);
    if ("live" in target.dataset) typed(target, true);
  }, true);
  addEventListener("change", ({ target }) => {
    if (!target.dataset?.field || ("live" in target.dataset && !target.dataset.done)) return;
    // An arrow key has sent this value already: sent again, it could undo a change that was made since.
    if (target.matches(TYPED_INTO) && !edited.has(target)) return;
    typed(target);
    if (byPointer && !target.matches(TYPED_INTO)) target.blur();
  }, true);
  addEventListener(
    "keydown",
    (event) => {
      const input = event.target;
      if ((event.key !== "Enter" && event.key !== "Escape") || !(input instanceof HTMLInputElement) || !input.matches(TYPED)) return;
      if (input.dataset.field && event.key === "Escape") {
        if ("live" in input.dataset) input.value = "";
        else showValues("", input);
        if ("live" in input.dataset) typed(input);
      }
      if (input.dataset.enter && event.key === "Enter") ask(JSON.parse(input.dataset.enter));
      // A dialog handles both keys itself.
      if (!input.closest("[role=dialog]")) input.blur();
    },
  );

  // Copy the server's values into inputs that are not in use. Also into two inputs that may be in use: `into`, and the input with
  // the data-field `refused`, whose value was refused (unless the user has edited it since).
  function showValues(refused = "", into = null) {
    for (const shows of document.querySelectorAll("[data-shows]")) {
      for (const [name, value, off, { options, bounds }] of JSON.parse(shows.dataset.shows)) {
        for (const input of document.getElementsByName(name)) {
          const of = input.dataset.field;
          input.disabled = off;
          if (options) offer(input, options);
          if (bounds) bound(input, bounds);
          const used = document.activeElement === input && input !== into && (of !== refused || edited.has(input));
          if (newest.has(of) || isUnanswered(of)) continue;
          const [shown, until] = entered.get(of) ?? ["", 0];
          if (shown === String(value)) entered.delete(of); // drawn: other commands may change it from now on
          else if (performance.now() < until) continue;
          if (used) continue;
          if (input.type === "checkbox") input.checked = value;
          else if (input.value !== String(value)) input.value = value;
        }
      }
    }
  }

  function offer(select, options) {
    const encoded = JSON.stringify(options);
    if (select.dataset.options === encoded) return;
    select.dataset.options = encoded;
    select.replaceChildren(...options.map(([shown, value]) => new Option(shown, value)));
  }

  function bound(input, [low, high]) {
    if (input.type === "range") [input.min, input.max] = [low, high];
    else input.dataset.number = JSON.stringify([low, high, ...JSON.parse(input.dataset.number).slice(2)]);
    if (input.type === "range") input.step = JSON.parse(input.parentElement.querySelector("[data-number]").dataset.number)[2];
  }
  addEventListener("focusout", () => setTimeout(showValues), true);

  // --- focus ------------------------------------------------------------------------------------------------------------

  // A clicked control gives up the focus, so that the page's keys keep working: a focused button would handle Space itself.
  // With Tab navigation the focus stays.
  let byPointer = false;
  let focused = "";
  addEventListener("pointerdown", () => {
    byPointer = true;
    focused = "";
  }, true);
  function giveBack(event) {
    if (event.type === "click" && event.detail === 0) return;
    const here = document.activeElement;
    if (!here || here === document.body) return;
    if (!here.matches(TYPED) || event.target instanceof HTMLCanvasElement) here.blur();
  }
  let again = 0;
  for (const kind of ["pointerup", "click"]) {
    addEventListener(
      kind,
      (event) => {
        giveBack(event);
        // Repeat: some controls take the focus in later handlers.
        clearTimeout(again);
        again = setTimeout(() => byPointer && giveBack(event), 50);
      },
      true,
    );
  }

  // A redraw that replaces the focused element loses the focus; move it to the new element with the same command.
  addEventListener("focusin", ({ target }) => {
    const { do: does, fold } = (!byPointer && target.closest("[data-do], [data-fold]")?.dataset) || {};
    focused = does ? `[data-do="${CSS.escape(does)}"]` : fold ? `[data-fold="${CSS.escape(fold)}"]` : "";
  }, true);
  addEventListener("focusout", ({ relatedTarget }) => relatedTarget && (focused = ""), true);

  // --- elements added to the page -----------------------------------------------------------------------------------------

  // Functions by data attribute: each is called once for each element that has the attribute.
  const arrivals = {
    tell(element) {
      const { tell, only } = element.dataset;
      if (!only || document.documentElement.hasAttribute(`data-${only}`)) send(JSON.parse(tell));
    },
    drive() {
      padBeat ||= setInterval(readPad, PAD_BEAT);
    },
    seen(element) {
      new IntersectionObserver((changes, observer) => {
        // A busy browser reports several changes at once, the oldest first: out of sight, then in sight.
        if (!changes.some(({ isIntersecting }) => isIntersecting)) return;
        observer.disconnect();
        send(JSON.parse(element.dataset.seen));
      }).observe(element);
    },
    autofocus(input) {
      input.focus();
      input.select();
    },
    // Repeat, since neighbouring elements are added a moment later.
    intoSight(element) {
      const show = () => element.parentElement?.scrollIntoView({ block: "nearest" });
      show();
      setTimeout(show, 150);
    },
    follow(element) {
      document.querySelector(`.wb-library [data-row="${CSS.escape(element.dataset.follow)}"]`)?.scrollIntoView({ block: "nearest" });
    },
  };
  const arrived = new WeakSet();
  const attribute = (name) => `data-${name.replace(/[A-Z]/g, (letter) => `-${letter.toLowerCase()}`)}`;

  document.title = "Workbench";
  new MutationObserver(() => {
    const now = document.querySelector("[data-page]")?.dataset.page ?? page;
    if (now !== page) {
      page = now;
      connect();
    }
    const title = document.querySelector("[data-title]")?.dataset.title;
    if (title && title !== document.title) document.title = title;
    for (const [name, then] of Object.entries(page ? arrivals : {})) {
      for (const element of document.querySelectorAll(`[${attribute(name)}]`)) {
        if (arrived.has(element)) continue;
        arrived.add(element);
        then(element);
      }
    }
    if (focused && document.activeElement === document.body) {
      document.querySelector(`[tabindex]${focused}`)?.focus({ preventScroll: true });
    }
    showValues();
  }).observe(document, { childList: true, subtree: true, attributes: true, attributeFilter: ["data-page", "data-shows", "data-title"] });

  window.wb = { ask, arrivals, isTyping: () => Boolean(document.activeElement?.closest(TYPED)) };
}
