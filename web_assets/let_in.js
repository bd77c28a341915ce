// Loads a page anew that is not let in any more, so that it says so and what to do: viser's page would go on asking for
// its connection, once a second, for a token that was renewed or a workbench that was started again.
"use strict";
{
  const TRIES = 3; // of viser's, a second each: a server that is just starting again is waited for
  const postMessage = Worker.prototype.postMessage;
  let tries = 0;

  Worker.prototype.postMessage = function (message, ...rest) {
    if (message?.type === "retry") ask(++tries);
    else if (message?.type === "send") tries = 0;
    return postMessage.call(this, message, ...rest);
  };

  async function ask(number) {
    if (number % TRIES !== 0) return;
    const answer = await fetch("/workbench/logo.svg", { cache: "no-store" }).catch(() => null);
    if (answer?.status === 403) location.reload();
  }
}
