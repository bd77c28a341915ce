// What a page does that has lost its server. It says so in a sentence, with what to do: viser's page shows a cloud that turns
// into dots. And it is loaded anew if it is not let in any more, which says why: viser would go on asking, once a second,
// for a connection with a token that was renewed.
"use strict";
{
  const TRIES = 3; // of viser's, a second each: a server that is just starting again is waited for
  const PATIENCE = 1500; // milliseconds without a connection, after which it is said
  const postMessage = Worker.prototype.postMessage;
  const heard = new WeakSet();
  let tries = 0;
  let waiting = 0;
  let notice = null;

  Worker.prototype.postMessage = function (message, ...rest) {
    if (message?.type === "set_server" && !heard.has(this)) {
      heard.add(this);
      this.addEventListener("message", ({ data }) => follow(data?.type));
    }
    if (message?.type === "retry") ask(++tries);
    else if (message?.type === "send") tries = 0;
    return postMessage.call(this, message, ...rest);
  };

  async function ask(number) {
    if (number % TRIES !== 0) return;
    const answer = await fetch("/workbench/logo.svg", { cache: "no-store" }).catch(() => null);
    if (answer?.status === 403) location.reload();
  }

  // "connected" and "closed" are viser's words for its connection (WebsocketClientWorker.ts, 1.1).
  function follow(type) {
    if (type === "closed") waiting ||= setTimeout(tell, PATIENCE);
    if (type !== "connected") return;
    clearTimeout(waiting);
    waiting = 0;
    notice?.remove();
    notice = null;
  }

  function tell() {
    notice = document.createElement("div");
    notice.className = "wb-server-gone";
    notice.setAttribute("role", "alert");
    const what = document.createElement("b");
    what.textContent = `No answer from the workbench at ${location.host}.`;
    const toDo = document.createElement("span");
    toDo.textContent =
      " What you see is the last that it sent, and nothing here can be pressed. If its command still runs in a terminal, look at the way there (network, ssh). If it has ended, start it again and open the address that it prints. This page goes on by itself as soon as it answers.";
    notice.append(what, toDo);
    document.body.append(notice);
  }
}
