// A page that is drawn in software draws its view in less time, and keeps one resolution, so that it never stands still to
// change it. Whoever has a graphics card keeps what viser does.
//
// Less time: of simplified shapes, which the server sends to such pages; while something moves and frames come slowly, of
// fewer pixels; without smoothed edges, which are half of a frame, without a copy of each frame for scripts that read it back,
// and without the highlights of materials. The texts that are exchanged are three.js's in viser 1.1; where one is another,
// it is drawn as it is.
//
// One resolution, of its buffers: viser lowers the resolution of its view when frames come slowly, and raises it again. On a graphics card that costs
// nothing that is seen. Where the browser draws on the processor, new buffers wait for all that is still to be drawn:
// the page answers nothing for 0.2 to 0.8 s, at moments that nobody chose (it goes down, up, and down again), one of
// them the first seconds in which the author's code hangs and the page is needed most. Such a page therefore stays at
// the resolution it begins with. Not at a lower one: what lies over the view (the timeline, a banner) is fitted to the
// view's width, which viser tells in these pixels.
//
// viser reads a fixed resolution from its address, once, before it makes its canvas: so it is put there for that long,
// and not left behind in what people bookmark or copy. One that stands there already is somebody's wish.
"use strict";
{
  const KEY = "fixedDpr"; // viser 1.1, DevSettingsStore.ts
  const SOFTWARE = /swiftshader|llvmpipe|softpipe|software/i; // as in its BrowserWarning.tsx

  const [SHARP, LOWER, LOWEST] = [1, 0.7, 0.5]; // of the resolution along each side; the latter while something moves
  const SLOW = 60; // milliseconds from one frame to the next
  const SLOW_FRAMES = 3; // in a row; then LOWER
  const LATE = 100; // milliseconds
  const LATE_FRAMES = 8; // then LOWEST
  const STILL = 600; // milliseconds

  const CHEAPER = [
    [
      "vec3 specularBRDF = BRDF_GGX( directLight.direction, geometryViewDir, geometryNormal, material );",
      "vec3 specularBRDF = vec3( 0.0 );",
    ],
    ["vec3 F = F_Schlick( material.specularColor, material.specularF90, dotVH );", "vec3 F = material.specularColor;"],
    ["RE_IndirectSpecular( radiance, iblIrradiance, clearcoatRadiance,", "if ( false ) RE_IndirectSpecular( radiance, iblIrradiance, clearcoatRadiance,"],
    ["material.dfg = texture2D( dfgLUT, vec2( material.roughness, dotNVms ) ).rg;", "material.dfg = vec2( 1.0, 0.0 );"],
    ["vec3 dxy = max( abs( dFdx( nonPerturbedNormal ) ), abs( dFdy( nonPerturbedNormal ) ) );", "vec3 dxy = vec3( 0.0 );"],
    // Of a vertex of what is drawn many times: whole numbers are divided one by one, others four at once.
    ["int x = j % size;\n    int y = j / size;", "int y = int( ( float( j ) + 0.5 ) / float( size ) );\n    int x = j - y * size;"],
  ];

  function isDrawnInSoftware() {
    const gl = document.createElement("canvas").getContext("webgl2");
    if (!gl) return false;
    const named = gl.getExtension("WEBGL_debug_renderer_info");
    const renderer = named ? gl.getParameter(named.UNMASKED_RENDERER_WEBGL) : "";
    // A browser has only so many contexts, and else keeps this one until its memory is searched for garbage.
    gl.getExtension("WEBGL_lose_context")?.loseContext();
    return SOFTWARE.test(renderer);
  }

  // While something moves the view is drawn into a part of its canvas, which is shown as large as all of it
  // (object-view-box): no buffer is made, and all that goes by the size of the canvas stays.
  function drawLessWhileMoving(gl, canvas) {
    if (!CSS.supports("object-view-box", "inset(0 1% 1% 0)")) return;
    const own = WebGL2RenderingContext.prototype;
    let asked = [0, 0, canvas.width, canvas.height];
    let toScreen = true;
    let part = SHARP;
    let last = 0;
    let passed = 3; // of the browser's frames since the last one of the view, counted to three
    let counting = false;
    let slow = 0; // frames in a row
    let late = 0; // frames of them

    function setViewport() {
      const [x, y, width, height] = asked.map((pixels) => (toScreen ? Math.round(part * pixels) : pixels));
      own.viewport.call(gl, x, y, width, height);
    }
    gl.viewport = (...rectangle) => {
      asked = rectangle;
      setViewport();
    };
    gl.bindFramebuffer = (target, buffer) => {
      own.bindFramebuffer.call(gl, target, buffer);
      if (target === gl.READ_FRAMEBUFFER) return;
      toScreen = !buffer;
      setViewport();
    };
    // A frame begins with it.
    gl.clear = (mask) => {
      if (toScreen && canvas.isConnected) chooseResolution();
      own.clear.call(gl, mask);
    };

    function pass() {
      passed += 1;
      counting = passed < 3;
      if (counting) requestAnimationFrame(pass);
    }
    function chooseResolution() {
      const since = performance.now() - last;
      last += since;
      // By the browser's own frames, since on a busy machine two that follow each other are a second apart, as are those that
      // viser draws when nothing moves.
      if (passed > 2) [slow, late] = since > STILL ? [0, 0] : [slow, late];
      else if (since > SLOW) [slow, late] = [slow + 1, late + (since > LATE)];
      else if (slow < SLOW_FRAMES) [slow, late] = [0, 0];
      passed = 0;
      if (!counting) requestAnimationFrame(pass);
      counting = true;
      const wanted = slow < SLOW_FRAMES ? SHARP : late < LATE_FRAMES ? LOWER : LOWEST;
      if (wanted === part) return;
      part = wanted;
      const [right, top] = [canvas.width, canvas.height].map((all) => 100 * (1 - Math.round(part * all) / all));
      canvas.style.objectViewBox = part === SHARP ? "" : `inset(${top}% ${right}% 0 0)`;
      setViewport();
    }
  }

  function drawInLessTime() {
    const seen = new WeakSet();
    const { getContext } = HTMLCanvasElement.prototype;
    HTMLCanvasElement.prototype.getContext = function (kind, asked) {
      const cheaper = kind === "webgl2" ? { ...asked, antialias: false, preserveDrawingBuffer: false } : asked;
      const context = getContext.call(this, kind, cheaper);
      if (context && kind === "webgl2" && !seen.has(context)) {
        seen.add(context);
        drawLessWhileMoving(context, this);
      }
      return context;
    };
    const { shaderSource } = WebGL2RenderingContext.prototype;
    WebGL2RenderingContext.prototype.shaderSource = function (shader, text) {
      const exchanged = CHEAPER.reduce((source, [was, becomes]) => source.replaceAll(was, becomes), text);
      return shaderSource.call(this, shader, exchanged);
    };
  }

  function changeAddress(change) {
    const address = new URL(location.href);
    change(address.searchParams);
    history.replaceState(history.state, "", address);
  }

  // viser's notice of it lies over the view, in each new tab, until it is closed by hand. Once is enough, and a while.
  function closeNotice() {
    const [NOTICE, TOLD, STAYS] = ["webgl-software-rendering", "wb-told-software", 8000]; // viser 1.1, BrowserWarning.tsx
    const seen = new MutationObserver(() => {
      const notice = document.getElementById(NOTICE);
      if (!notice) return;
      seen.disconnect();
      const told = localStorage.getItem(TOLD);
      localStorage.setItem(TOLD, "yes");
      setTimeout(() => notice.querySelector("button")?.click(), told ? 0 : STAYS);
    });
    seen.observe(document, { childList: true, subtree: true });
  }

  const software = isDrawnInSoftware();
  // For `unfolded.js`, which says so to the server (`Presses.when_drawn_in_software`): it sends simpler shapes then.
  if (software) document.documentElement.dataset.drawnInSoftware = "yes";
  if (software) drawInLessTime();
  if (software) closeNotice();
  if (software && !new URLSearchParams(location.search).has(KEY)) {
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
