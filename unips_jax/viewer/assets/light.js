// The light: by the pointer, by two sliders, by keys; all show the same direction.

/** Where the light is; `changed` is called with its direction. */
class Light {
  constructor(changed) {
    this.changed = changed;
    this.azimuth = 45; // degrees: 0 right, 90 above
    this.elevation = 45; // over the picture's plane
    for (const name of ["azimuth", "elevation"]) {
      byId(name).addEventListener("input", () => {
        this[name] = Number(byId(name).value);
        this.apply();
      });
    }
  }

  /** By a place of the stage: its middle is a light from in front, its edge a raking
   * one, as if the pointer were on a sphere around the object. */
  follow(x, y, [width, height]) {
    const radius = Math.min(width, height) / 2;
    const [right, up] = [(x - width / 2) / radius, -(y - height / 2) / radius];
    const length = Math.min(Math.hypot(right, up), 0.995);
    this.azimuth = (Math.atan2(up, right) * 180) / Math.PI;
    this.elevation = (Math.acos(length) * 180) / Math.PI;
    this.apply();
  }

  /** By degrees to the right and up. */
  nudge(right, up) {
    const [x, y] = this.direction();
    const turn = (value, by) => Math.asin(Math.max(-1, Math.min(1, value))) + (by * Math.PI) / 180;
    const limit = (angle) => Math.sin(Math.max(-1.45, Math.min(1.45, angle)));
    const [a, b] = [limit(turn(x, right)), limit(turn(y, up))];
    const length = Math.min(Math.hypot(a, b), 0.995);
    this.azimuth = (Math.atan2(b, a) * 180) / Math.PI;
    this.elevation = (Math.acos(length) * 180) / Math.PI;
    this.apply();
  }

  direction() {
    const [a, e] = [this.azimuth, this.elevation].map((value) => (value * Math.PI) / 180);
    return [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
  }

  apply() {
    const azimuth = Math.round(this.azimuth);
    const side = say("sides").split(",")[((Math.round(azimuth / 45) % 8) + 8) % 8];
    byId("azimuth").value = azimuth;
    byId("azimuth").setAttribute("aria-valuetext", say("azimuth_value", azimuth, side));
    byId("elevation").value = Math.round(this.elevation);
    const height = say("degrees", Math.round(this.elevation));
    byId("elevation").setAttribute("aria-valuetext", height);
    this.changed(this.direction());
  }
}
