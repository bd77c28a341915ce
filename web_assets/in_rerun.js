// Runs in rerun's own page, before rerun's scripts.
"use strict";
// rerun 0.41 fetches recordings without cookies, and the server refuses requests without the token's cookie.
const fetch_as_told = window.fetch;
window.fetch = (what, how) => fetch_as_told(what, { ...how, credentials: "same-origin" });
{
  const asked = new URLSearchParams(location.search);
  const varint = (n) => { const out = []; for (; n > 127; n = Math.floor(n / 128)) out.push((n % 128) | 128); return [...out, n]; };
  const field = (number, bytes) => [number * 8 + 2, ...varint(bytes.length), ...bytes];
  const text = (string) => [...new TextEncoder().encode(string)];
  // Protobuf field numbers: set_time_cursor of ViewerControlRequest = 6; in it store_id = 1, timeline.name = 2.1, time.time = 3.1,
  // play_state = 5 (paused).
  const set_time = (recording, step) => new Uint8Array(field(6, [
    ...field(1, text(recording)), ...field(2, field(1, text("step"))), ...field(3, [8, ...varint(step)]), 40, 1]));
  const go = async (recording, step) => {
    // rerun rejects the message until it has read the recording up to this step.
    for (let tries = 0; tries < 300; tries++) {
      await new Promise((done) => setTimeout(done, 200));
      try {
        await window._handle.viewer_control(set_time(recording, step));
        return;
      } catch { }
    }
    console.warn("rerun was not told to open at step " + step);
  };
  for (const moment of asked.getAll("at")) {
    const end = moment.lastIndexOf("@");
    go(moment.slice(0, end), Number(moment.slice(end + 1)));
  }
  // rerun takes the keyboard focus when it starts; in a panel the keys belong to the page until the user clicks into rerun.
  const giveBack = ({ target }) => { target.blur(); frameElement.blur(); };
  if (parent !== window) addEventListener("focusin", giveBack);
  addEventListener("pointerdown", () => removeEventListener("focusin", giveBack), true);
  addEventListener("load", () => { document.title = asked.get("title") || document.title; });
}
