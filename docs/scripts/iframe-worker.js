// Search without a web server: browsers refuse workers on pages from the file system,
// so there the script of a worker runs in a hidden frame.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.pending = [];
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.documentElement.append(frame);
      this.scope = frame.contentWindow;
      this.scope.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      const script = this.scope.document.createElement("script");
      script.src = url;
      script.onload = () => {
        this.pending.forEach((data) => this.deliver(data));
        this.pending = null;
      };
      this.scope.document.documentElement.append(script);
    }

    postMessage(data) {
      if (this.pending) this.pending.push(data);
      else this.deliver(data);
    }

    deliver(data) {
      this.scope.dispatchEvent(new this.scope.MessageEvent("message", { data }));
    }
  };
}
