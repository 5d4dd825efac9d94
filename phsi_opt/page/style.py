"""How the page looks: colours of light and dark, and a few rules.

Every pair of text and ground has a contrast of at least 4.5:1. No colour stands alone:
a word says the same.
"""

PRIMARY = "#1f5fa8"  # 6.5:1 below white text
ON_PRIMARY = "#ffffff"
CSS = """
:root {
  --ink: #16191d; --faint: #4d5661; --ground: #f4f6f8; --card: #ffffff;
  --line: #c9d0d8; --good: #1d6b3d; --bad: #9f2f14; --look: #7a4d00; --strong: #1f5fa8;
  --good-ground: #e6f4ea; --bad-ground: #fdebe5;
}
body.body--dark {
  --ink: #eef1f4; --faint: #b4bdc7; --ground: #101317; --card: #1a1e24;
  --line: #3a424c; --good: #86d3a3; --bad: #ffab8f; --look: #f2bd4d; --strong: #8fc1f7;
  --good-ground: #14301f; --bad-ground: #3a1c12;
}
body { background: var(--ground) !important; color: var(--ink); }
.page { width: 100%; max-width: 1180px; margin: 0 auto; padding: 12px; }
.card {
  background: var(--card); border: 1px solid var(--line); border-radius: 8px;
  padding: 14px 16px; width: 100%; min-width: 0; color: var(--ink);
}
.two { display: grid; grid-template-columns: minmax(0, 3fr) minmax(0, 2fr); gap: 12px; }
.facts {
  display: grid; gap: 14px;
  grid-template-columns:
    minmax(0, 1.5fr) minmax(0, 1fr) minmax(0, 0.8fr) minmax(0, 1.1fr);
}
.tiles {
  display: grid; gap: 10px; width: 100%;
  grid-template-columns: repeat(auto-fill, minmax(300px, 1fr));
}
.tile {
  display: flex; flex-direction: column; text-align: left; padding: 10px 12px;
  background: var(--card); color: var(--ink);
  border: 1px solid var(--line); border-radius: 8px; cursor: pointer; font: inherit;
}
.tile:hover, .tile.chosen { border-color: var(--strong); }
.tile.chosen { box-shadow: inset 0 0 0 1px var(--strong); }
.fields { display: flex; flex-wrap: wrap; gap: 8px 12px; align-items: flex-end; }
h1, h2, h3 { margin: 0; padding: 0; line-height: 1.3; font-weight: 600; }
h1 { font-size: 20px; } h2 { font-size: 17px; } h3 { font-size: 15px; }
p { margin: 0; line-height: 1.45; overflow-wrap: anywhere; }
.badge {
  border: 2px solid currentColor; border-radius: 8px; padding: 1px 10px;
  font-weight: 600; font-size: 17px;
}
.sentence { font-size: 18px; line-height: 1.35; font-weight: 600; }
.faint { color: var(--faint); }
.look { color: var(--look); } .good { color: var(--good); } .bad { color: var(--bad); }
.alert {
  background: var(--bad-ground); color: var(--bad); border: 1px solid currentColor;
  border-radius: 8px; padding: 10px 12px; width: 100%; overflow-wrap: anywhere;
}
.open {
  border: 1px solid var(--line); border-radius: 8px; padding: 8px 12px; width: 100%;
}
.fine {
  background: var(--good-ground); color: var(--good); border-radius: 8px;
  padding: 8px 12px; width: 100%;
}
.formula { font-family: ui-monospace, monospace; overflow-wrap: anywhere; }
.track {
  position: relative; height: 10px; border-radius: 5px; background: var(--line);
  width: 100%; overflow: hidden;
}
.track div { position: absolute; inset: 0 auto 0 0; background: #2f7fd6; }
.track i {
  position: absolute; top: 0; bottom: 0; width: 3px; margin-left: -3px;
  background: var(--ink);
}
.candidate { border-top: 1px solid var(--line); padding: 10px 0; width: 100%; }
html { scroll-padding: 72px 0 64px; }
/* Quasar takes outlines away with !important in a layer, which wins: so shadows. */
:focus-visible { outline: 3px solid var(--strong) !important; outline-offset: 2px; }
.q-btn:focus-visible, .q-tab:focus-visible, .q-item:focus-visible,
.q-checkbox:focus-visible, .q-field:has(:focus-visible) .q-field__control {
  box-shadow: 0 0 0 2px var(--card), 0 0 0 5px var(--strong) !important;
}
.skip { position: absolute; left: -999px; top: 4px; z-index: 9999; }
a.skip:focus {
  left: 8px; background: var(--card); padding: 6px;
  -webkit-text-fill-color: var(--strong);
}
.q-btn.disabled { --q-primary: var(--line); --q-onprimary: var(--ink); }
.q-btn.disabled { color: var(--ink) !important; }
.q-header, .q-footer {
  background: var(--card) !important; color: var(--ink) !important;
  border-color: var(--line);
}
.q-header h1 { white-space: nowrap; }
.q-footer { padding: 0 !important; }
.q-footer .page { padding: 4px 12px; min-height: 36px; }
.q-header { border-bottom: 1px solid var(--line); }
.q-footer { border-top: 1px solid var(--line); }
.q-field__label, .q-field__messages, .q-uploader__subtitle { color: var(--faint); }
.q-field__native, .q-field__input { color: var(--ink); }
.q-field--float .q-field__native::placeholder {
  color: var(--faint) !important; opacity: 1;
}
.q-tab-panels, .q-tab-panel { background: transparent !important; padding: 0; }
body.body--dark { --q-primary: #8fc1f7 !important; --q-onprimary: #0d1b2a !important; }
.drop {
  position: relative; width: 100%; border: 2px dashed var(--faint);
  border-radius: 8px; padding: 22px; text-align: center;
}
.drop .q-uploader {
  position: absolute; inset: 0; width: 100%; height: 100%; max-height: none; opacity: 0;
}
.drop .q-uploader__header, .drop .q-uploader__list { display: none; }
.drop .q-btn, .drop .said { position: relative; z-index: 1; }
.drop .said { pointer-events: none; }
.q-btn { text-transform: none; }
.js-plotly-plot text { fill: var(--ink) !important; }
.js-plotly-plot .hoverlayer text { fill: #f4f6f8 !important; }
.js-plotly-plot .gridlayer path { stroke: var(--line) !important; }
@media (max-width: 760px) {
  .facts { grid-template-columns: minmax(0, 1fr); }
  .two { display: flex; flex-direction: column; }
  .two > * { display: contents !important; }
  .two .last { order: 9; }
  .facts { gap: 8px; }
  .page { padding: 8px; }
  .q-header { gap: 4px; padding: 2px 8px; flex-wrap: nowrap; }
  .q-header h1 { display: none; }
  .q-tab { padding: 0 10px; }
  .q-header .q-btn { padding: 4px 6px; }
}
@media (prefers-reduced-motion: reduce) { * { transition: none !important; } }
"""
