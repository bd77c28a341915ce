// Says what is missing where the browser has no WebGL 2: viser then draws nothing, and no panel comes either.
"use strict";
{
  const context = document.createElement("canvas").getContext("webgl2");
  // A browser keeps some sixteen at most.
  context?.getExtension("WEBGL_lose_context")?.loseContext();
  const ways = [
    ["Chrome, Edge, Chromium", "in Settings, System, turn on “Use graphics acceleration when available”, and restart the browser. chrome://gpu says what is off."],
    ["Firefox", "open about:config, and set webgl.disabled to false and webgl.force-enabled to true. about:support, Graphics, says what is off."],
    ["No GPU (a virtual machine, a remote desktop)", "start Chrome or Chromium with --enable-unsafe-swiftshader, which draws in software; or forward the port over ssh and open the page in a browser on your own machine."],
  ];
  function tell() {
    const box = document.createElement("div");
    box.className = "wb-needs-webgl";
    box.setAttribute("role", "alert");
    const title = document.createElement("h1");
    title.textContent = "This browser has no WebGL 2";
    const text = document.createElement("p");
    text.textContent = "Workbench draws its 3-D view with WebGL 2, and shows nothing without it. The workbench itself is running. What to do:";
    const list = document.createElement("ul");
    for (const [where, what] of ways) {
      const item = document.createElement("li");
      const name = document.createElement("b");
      name.textContent = `${where}: `;
      item.append(name, what);
      list.append(item);
    }
    box.append(title, text, list);
    document.body.append(box);
  }
  if (!context) {
    if (document.body) tell();
    else addEventListener("DOMContentLoaded", tell);
  }
}
