// Added to viser's page: pictures that keep up with the motion where drawing is slow, and room for the scene.
(() => {
  const SLOW = 40, FAST = 22;        // [ms] of a picture, beyond which it becomes coarser or finer
  const STILL = 350, ALONE = 900;    // [ms] without pictures: the scene stands; viser draws a still one every second
  const CALM = 3;                    // times the last gap between pictures that the scene must stand before it is sharp
  const FEW = 4;                     // pictures between two decisions
  const COARSEST = 0.25, SMOOTH = 1.5; // pixels of the picture for each of the screen; without a graphics card, when still
  const NARROW = 1100;               // [px] of the window below which the readings begin folded

  const software = /swiftshader|llvmpipe|softpipe|software/i.test(renderer());
  if (software) withoutAntialiasing();
  document.addEventListener("DOMContentLoaded", () => {
    styled();
    if (innerWidth < NARROW) fold();
    if (software) once(warning, button => button.click());
  });
  if (!new URLSearchParams(location.search).has("fixedDpr"))
    once(() => window.__viserTestpoints?.rendererInfo && window.__viserTestpoints.devSettings?.set, follow);

  function renderer() {
    const gl = document.createElement("canvas").getContext("webgl2");
    if (!gl) return "";
    const named = gl.getExtension("WEBGL_debug_renderer_info");
    const name = String(gl.getParameter(named ? named.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
    gl.getExtension("WEBGL_lose_context")?.loseContext();
    return name;
  }

  // In software, four samples a pixel take twice the time; a still picture is drawn larger instead.
  function withoutAntialiasing() {
    const original = HTMLCanvasElement.prototype.getContext;
    HTMLCanvasElement.prototype.getContext = function (kind, options) {
      return original.call(this, kind, String(kind).startsWith("webgl") ? {...options, antialias: false} : options);
    };
  }

  // On phones the panel is as wide as the screen, and the scene has the upper half.
  function styled() {
    const style = document.createElement("style");
    style.textContent = `@media (max-width: 576px) {
      div[style*="max-height: 60%"] { width: 100% !important; max-height: 50% !important }
      div[style*="max-height: 60%"] div[style*="width: 20em"] { width: 100% !important }
      div:has(> div > canvas[style*="pointer-events: none"]) { height: 50% !important }
    }`;
    document.head.append(style);
  }

  // viser's note on software rendering; what it announces is what this script takes care of.
  function warning() {
    const notes = [...document.querySelectorAll(".mantine-Notification-root")];
    return notes.find(note => note.textContent.includes("Software WebGL"))?.querySelector("button");
  }

  function once(find, act, tries = 300) {
    const found = find();
    if (found) act(found);
    else if (tries) setTimeout(() => once(find, act, tries - 1), 100);
  }

  // Folds the readings, and again if viser opens them while it places the panels, unless the user has acted by then.
  function fold() {
    const open = () => document.querySelector('[data-dock-region-collapse="left"][aria-expanded="true"]');
    let alone = true;
    addEventListener("pointerdown", () => { alone = false; }, {once: true});
    once(open, button => {
      button.click();
      for (let k = 1; k <= 10; ++k) setTimeout(() => alone && open()?.click(), 200 * k);
    });
  }

  // Pixels follow the time of the pictures while something moves; a still scene is drawn sharply.
  function follow() {
    const {rendererInfo, devSettings} = window.__viserTestpoints;
    let finest = devicePixelRatio, moving = software ? finest / 2 : finest, last = rendererInfo.render.frame, drawn = performance.now();
    let gaps = [], pace = 0, pass = 0, sharp = false, down = false;
    const set = dpr => { devSettings.set({fixedDpr: dpr}); gaps = []; pass = 2; };
    const move = () => { if (sharp) { sharp = false; pace = STILL; set(moving); } };
    addEventListener("pointerdown", () => { down = true; move(); }, true);
    for (const end of ["pointerup", "pointercancel"]) addEventListener(end, () => { down = false; }, true);
    for (const begin of ["click", "wheel", "keydown"]) addEventListener(begin, move, {capture: true, passive: true});
    requestAnimationFrame(function watch(now) {
      requestAnimationFrame(watch);
      finest = devicePixelRatio;
      if (rendererInfo.render.frame === last) {
        if (!sharp && !down && now - drawn > Math.max(STILL, Math.min(CALM * pace, ALONE))) { sharp = true; set(software ? SMOOTH * finest : finest); }
        return;
      }
      const gap = now - drawn;
      last = rendererInfo.render.frame;
      drawn = now;
      if (pass > 0) { pass -= 1; return; } // the change of resolution itself
      if (gap > ALONE) { gaps = []; return; }
      move();
      pace = gap;
      gaps.push(gap);
      if (gaps.length < FEW) return;
      const time = gaps.sort((a, b) => a - b)[FEW >> 1];
      gaps = [];
      const next = time > SLOW ? moving * Math.max(0.6, Math.sqrt(SLOW / time) * 0.95) : time < FAST ? moving * 1.15 : moving;
      const bounded = Math.min(finest, Math.max(COARSEST * finest, next));
      if (Math.abs(bounded - moving) > 0.02) { moving = bounded; set(moving); }
    });
  }
})();
