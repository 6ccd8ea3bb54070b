// Time: a slider, play and pause, loop and speed.

class Player {
  constructor(scene, { bar, time, play, seconds, loop, speed }, changed) {
    Object.assign(this, { scene, changed, time: scene.time || 0, playing: false });
    Object.assign(this, { bar, slider: time, button: play, shown: seconds, loop, speed });
    this.bar.hidden = !scene.moves;
    this.step = 1 / Math.max(scene.frames - 1, 1);
    this.slider.step = "any";
    this.slider.addEventListener("input", () => this.seek(Number(this.slider.value)));
    this.button.addEventListener("click", () => this.toggle());
    // Keys are for the scene again once a part of the bar was clicked.
    this.bar.addEventListener("pointerup", ({ target }) => {
      if (target !== this.speed) setTimeout(() => target.blur(), 0);
    });
    this.speed.addEventListener("change", () => this.speed.blur());
    this.show();
  }

  seek(time) {
    this.time = Math.min(Math.max(time, 0), 1);
    this.show();
    this.changed();
  }

  toggle(playing = !this.playing) {
    this.playing = playing && this.scene.moves;
    if (this.playing && this.time >= 1) this.time = 0;
    this.show();
    this.changed();
  }

  // Goes on by `seconds` of the clock.
  advance(seconds) {
    if (!this.playing) return;
    let time = this.time + (seconds * Number(this.speed.value)) / this.scene.seconds;
    if (time > 1 && !this.loop.checked) this.playing = false;
    time = time > 1 ? (this.loop.checked ? time % 1 : 1) : time;
    this.time = time;
    this.show();
  }

  show() {
    this.slider.value = String(this.time);
    this.button.textContent = this.playing ? "❚❚" : "▶";
    this.button.setAttribute("aria-label", this.playing ? "Pause" : "Play");
    this.shown.textContent = `${(this.time * this.scene.seconds).toFixed(2)} / ${this.scene.seconds.toFixed(2)} s`;
  }
}
