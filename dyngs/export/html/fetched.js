// What comes from a web server: with an end where it cuts off or is silent, and again where that may help.

const SILENCE = 30000; // ms without a byte from which on a server counts as gone
const FIRST_WAIT = 1000; // ms until what did not arrive is asked for again; twice as long each further time
const LONGEST_WAIT = 30000;
const AT_ONCE = 6; // requests for parts

const aMoment = (wait = 20) => new Promise((resolve) => setTimeout(resolve, wait));
const waitAfter = (tries) => Math.min(FIRST_WAIT * 2 ** (tries - 1), LONGEST_WAIT);

// The bytes at an address, and the address that answered. Errors have `final` where asking again is of no use.
async function received(address, signal, again = false) {
  const request = new AbortController(), stop = () => request.abort(signal.reason);
  let timer;
  const heard = () => {
    clearTimeout(timer);
    timer = setTimeout(() => request.abort(new Error(`nothing came for ${SILENCE / 1000} s`)), SILENCE);
  };
  signal.addEventListener("abort", stop);
  try {
    heard();
    const answer = await fetch(address, { signal: request.signal, cache: again ? "reload" : "default" });
    if (!answer.ok) throw refusalOf(answer);
    const pieces = [], reader = answer.body.getReader();
    for (let piece = await reader.read(); !piece.done; piece = await reader.read()) {
      pieces.push(piece.value);
      heard();
    }
    return { address: answer.url, blob: new Blob(pieces) };
  } catch (error) {
    if (request.signal.aborted) throw request.signal.reason;
    if (error instanceof TypeError) error = new Error(unansweredLine(address));
    throw error;
  } finally {
    clearTimeout(timer);
    signal.removeEventListener("abort", stop);
  }
}

function refusalOf({ status, statusText }) {
  const final = status >= 400 && status < 500 && ![408, 425, 429].includes(status);
  return Object.assign(new Error(`the server answered ${status} ${statusText}`.trim()), { final });
}

// Browsers do not tell a page why there was no answer.
function unansweredLine(address) {
  const foreign = new URL(address).origin !== location.origin;
  return "no answer, or only a part of it" + (foreign ? "; does its server send Access-Control-Allow-Origin?" : "");
}

// The same, asked for until it is there; `tell` says in a line what goes wrong meanwhile.
async function insisted(address, signal, tell) {
  for (let tries = 1; ; ++tries)
    try {
      return await received(address, signal, tries > 1);
    } catch (error) {
      if (signal.aborted || error.final) throw error;
      tell(`${shortly(address)} has not arrived (${error.message}); trying again …`);
      await aMoment(waitAfter(tries));
    }
}

function shortly(address) {
  const { origin, pathname } = new URL(address);
  return (origin === location.origin ? "" : origin) + pathname;
}

// The parts of a scene that is fetched as it is seen. Those that do not arrive are asked for again while they are
// wanted, and hold up no others.
class Parts {
  // `take(name, blob)` keeps a part, `changed()` is called whenever there may be something to draw or to ask for.
  constructor({ base, signal, tell }, take, changed) {
    Object.assign(this, { base, signal, tell, take, changed, asked: new Set(), lost: new Map(), line: "" });
  }

  // Asks for the parts of these names, the most important ones first, as far as that is not done.
  want(names) {
    const now = performance.now();
    this.say(names);
    for (const name of names) {
      if (this.asked.size >= AT_ONCE) return;
      if (!this.asked.has(name) && !(this.lost.get(name)?.due > now)) this.ask(name);
    }
  }

  async ask(name) {
    this.asked.add(name);
    try {
      const { blob } = await received(new URL(name, this.base), this.signal, this.lost.has(name));
      await this.take(name, blob);
      this.lost.delete(name);
    } catch (error) {
      if (this.signal.aborted) return;
      const tries = (this.lost.get(name)?.tries ?? 0) + 1, wait = waitAfter(tries);
      this.lost.set(name, { tries, why: error.message, due: performance.now() + wait });
      setTimeout(this.changed, wait + 1);
    }
    this.asked.delete(name);
    this.changed();
  }

  // Says which of the wanted parts did not arrive.
  say(names) {
    const missing = names.filter((name) => this.lost.has(name));
    const [first] = missing, more = missing.length > 1 ? ` and ${missing.length - 1} more` : "";
    const line = first ? `${shortly(new URL(first, this.base))}${more} has not arrived ` +
      `(${this.lost.get(first).why}); trying again …` : "";
    if (line !== this.line) this.tell((this.line = line));
  }
}
