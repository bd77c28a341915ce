// Detects browsers without WebGL 2 or without hardware acceleration. Features to request from viser for the latter: no smoothed
// edges, no copy of each frame, fewer pixels during motion, a cheap material, a setting that turns viser's notice off.
"use strict";
{
  const SOFTWARE = /swiftshader|llvmpipe|softpipe|software/i; // as in viser's BrowserWarning.tsx
  const [TOLD, NOTICE] = ["wb-told-software", 8000]; // storage key; milliseconds
  const NO_WEBGL = `<h1>This browser has no WebGL 2</h1>
    <p>Workbench draws its 3-D view with WebGL 2, and shows nothing without it. The workbench itself is running. What to do:</p>
    <ul>
      <li><b>Chrome, Edge, Chromium:</b> in Settings, System, turn on “Use graphics acceleration when available”, and restart the browser. chrome://gpu says what is off.</li>
      <li><b>Firefox:</b> open about:config, and set webgl.disabled to false and webgl.force-enabled to true. about:support, Graphics, says what is off.</li>
      <li><b>No GPU (a virtual machine, a remote desktop):</b> start Chrome or Chromium with --enable-unsafe-swiftshader, which draws in software; or forward the port over ssh and open the page in a browser on your own machine.</li>
    </ul>`;

  function tellNoWebGL() {
    const box = document.createElement("div");
    box.className = "wb-needs-webgl";
    box.setAttribute("role", "alert");
    box.innerHTML = NO_WEBGL;
    document.body.append(box);
  }

  // viser lowers the resolution of its view when frames are slow. With software rendering the page is blocked for 0.2 to 0.8 s
  // while viser makes the new buffers. So this sets a fixed resolution in the page's address, which viser reads once, before it
  // makes its canvas. Afterwards the old address is restored, since users copy addresses.
  function fixResolution() {
    const KEY = "fixedDpr"; // viser 1.1, DevSettingsStore.ts
    const address = new URL(location.href);
    if (address.searchParams.has(KEY)) return;
    const before = address.href;
    address.searchParams.set(KEY, Math.min(Math.max(devicePixelRatio, 1), 2)); // like react-three-fiber's default
    history.replaceState(history.state, "", address);
    new MutationObserver((_, observer) => {
      if (!document.querySelector("canvas[data-engine]")) return;
      observer.disconnect();
      history.replaceState(history.state, "", before);
    }).observe(document, { childList: true, subtree: true });
  }

  const gl = document.createElement("canvas").getContext("webgl2");
  const named = gl?.getExtension("WEBGL_debug_renderer_info");
  if (!gl) addEventListener("DOMContentLoaded", tellNoWebGL);
  else if (named && SOFTWARE.test(gl.getParameter(named.UNMASKED_RENDERER_WEBGL))) {
    fixResolution();
    // Elements with data-only report software rendering to the server. viser's notice is shown once, for NOTICE (page.css).
    const { dataset } = document.documentElement;
    dataset.drawnInSoftware = localStorage.getItem(TOLD) ?? "";
    localStorage.setItem(TOLD, "told");
    setTimeout(() => (dataset.drawnInSoftware = "told"), NOTICE);
  }
  gl?.getExtension("WEBGL_lose_context")?.loseContext(); // browsers allow about sixteen contexts

  // viser's sorter of Gaussian splats, which the workbench does not use, evaluates strings when the page loads. The page's
  // policy forbids that, and the console would show an error.
  addEventListener("unhandledrejection", (event) => event.reason instanceof EvalError && event.preventDefault());
}
