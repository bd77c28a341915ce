// Our keys leave the 3-D view where it is.
//
// viser moves its view with W, A, S, D, Q, E and the arrows, and offers no way to take them from it. The same keys are
// commands here: S is a step, E the next env that failed, and the arrows walk through the past. So each press would
// also carry the view away, a tenth of a second at 50 degrees or two metres a second, and after twenty steps back one
// would look from behind. The view is moved with the pointer; F frames what is shown.
//
// viser listens for them on the document. Its commands are heard below that, on <html>, and come first; so here, on
// the document too and before viser's listener is there, such a press ends.
"use strict";
{
  const MOVE_THE_VIEW = ["KeyW", "KeyA", "KeyS", "KeyD", "KeyQ", "KeyE"]; // viser 1.1, CameraControls.tsx
  const TURN_IT = ["ArrowUp", "ArrowDown", "ArrowLeft", "ArrowRight"];
  const KEYS = new Set([...MOVE_THE_VIEW, ...TURN_IT]);

  document.addEventListener("keydown", (event) => {
    if (KEYS.has(event.code)) event.stopImmediatePropagation();
  });
}
