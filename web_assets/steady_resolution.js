// A page that is drawn in software keeps one resolution, and so never stands still to change it.
//
// viser lowers the resolution of its view when frames come slowly, and raises it again. On a graphics card that costs
// nothing that is seen. Where the browser draws on the processor, new buffers wait for all that is still to be drawn:
// the page answers nothing for 0.2 to 0.8 s, at moments that nobody chose (it goes down, up, and down again), one of
// them the first seconds in which the author's code hangs and the page is needed most. Such a page therefore stays at
// the resolution it begins with. Not at a lower one: what lies over the view (the timeline, a banner) is fitted to the
// view's width, which viser tells in these pixels. Whoever has a card keeps what viser does.
//
// viser reads a fixed resolution from its address, once, before it makes its canvas: so it is put there for that long,
// and not left behind in what people bookmark or copy. One that stands there already is somebody's wish.
"use strict";
{
  const KEY = "fixedDpr"; // viser 1.1, DevSettingsStore.ts
  const SOFTWARE = /swiftshader|llvmpipe|softpipe|software/i; // as in its BrowserWarning.tsx

  function isDrawnInSoftware() {
    const gl = document.createElement("canvas").getContext("webgl2");
    if (!gl) return false;
    const named = gl.getExtension("WEBGL_debug_renderer_info");
    const renderer = named ? gl.getParameter(named.UNMASKED_RENDERER_WEBGL) : "";
    // A browser has only so many contexts, and else keeps this one until its memory is searched for garbage.
    gl.getExtension("WEBGL_lose_context")?.loseContext();
    return SOFTWARE.test(renderer);
  }

  function changeAddress(change) {
    const address = new URL(location.href);
    change(address.searchParams);
    history.replaceState(history.state, "", address);
  }

  if (!new URLSearchParams(location.search).has(KEY) && isDrawnInSoftware()) {
    const beginsWith = Math.min(Math.max(devicePixelRatio, 1), 2); // as react-three-fiber's canvas by itself
    changeAddress((asked) => asked.set(KEY, beginsWith));
    const looked = new MutationObserver(() => {
      if (!document.querySelector("canvas[data-engine]")) return;
      looked.disconnect();
      changeAddress((asked) => asked.delete(KEY));
    });
    looked.observe(document, { childList: true, subtree: true });
  }
}
