"""The page's style sheet: light, system fonts, one column, prints well."""

CSS = """
:root { --ink: #1f2933; --muted: #616e7c; --rule: #e4e7eb; --soft: #f5f7fa; --accent: #0072b2; }
* { box-sizing: border-box; }
body { margin: 0; color: var(--ink); background: #fff; line-height: 1.5;
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", "DejaVu Sans", sans-serif; }
main { max-width: 1160px; margin: 0 auto; padding: 0 32px 64px; }
header { background: var(--soft); border-bottom: 1px solid var(--rule); }
header > div { max-width: 1160px; margin: 0 auto; padding: 36px 32px 24px; }
h1 { font-size: 30px; line-height: 1.2; margin: 0; letter-spacing: -0.01em; }
header p { margin: 6px 0 0; color: var(--muted); }
nav { margin-top: 18px; font-size: 13.5px; display: flex; flex-wrap: wrap; gap: 4px 18px; }
nav a { color: var(--accent); text-decoration: none; }
nav a:hover { text-decoration: underline; }
section { margin-top: 44px; }
h2 { font-size: 21px; margin: 0 0 4px; padding-top: 8px; }
h3 { font-size: 15px; margin: 26px 0 8px; }
section > p.lead { margin: 0 0 14px; color: var(--muted); max-width: 78ch; }
img { display: block; max-width: 100%; height: auto; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(165px, 1fr)); gap: 12px; margin: 28px 0 0; }
.card { border: 1px solid var(--rule); border-radius: 8px; padding: 14px 16px; }
.card .value { font-size: 25px; font-weight: 650; font-variant-numeric: tabular-nums; letter-spacing: -0.01em; }
.card .name { font-size: 13px; font-weight: 600; margin-top: 2px; }
.card .meaning { font-size: 12px; color: var(--muted); line-height: 1.35; margin-top: 4px; }
table { border-collapse: collapse; font-size: 13.5px; min-width: 55%; }
th, td { padding: 5px 14px 5px 0; text-align: left; border-bottom: 1px solid var(--rule); vertical-align: top; }
th + th, td + td, th + td { padding-left: 14px; }
thead th { color: var(--muted); font-weight: 600; font-size: 12.5px; vertical-align: bottom; background: #fff; }
tbody th { font-weight: 450; }
.num { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
thead .num { white-space: normal; }
td.floor { color: var(--muted); }
tr.stage th, tr.stage td { background: var(--soft); font-weight: 600; }
tr.stage th { padding-left: 8px; }
.indent { padding-left: 24px; }
.arrow { color: var(--muted); }
.note, p.missing { color: var(--muted); font-size: 13px; }
p.missing { background: var(--soft); border-left: 3px solid var(--rule); padding: 10px 14px; margin: 8px 0 0; }
.wide { overflow-x: auto; }
.tall table { width: 100%; }
.tall { max-height: 520px; overflow-y: auto; border: 1px solid var(--rule); border-radius: 8px; padding: 0 14px; }
.tall thead th { position: sticky; top: 0; padding-top: 8px; }
.tag { background: var(--soft); border: 1px solid var(--rule); border-radius: 10px; padding: 0 8px; font-size: 12.5px;
  white-space: nowrap; }
.triple { display: grid; grid-template-columns: repeat(3, 1fr); gap: 10px; }
.pictures { display: grid; grid-template-columns: repeat(2, 1fr); gap: 14px; }
figure { margin: 0; }
figure img { width: 100%; border-radius: 4px; }
.pictures figure img { border: 1px solid var(--rule); }
figcaption { font-size: 12.5px; color: var(--muted); margin-top: 3px; }
details { margin-top: 8px; }
summary { cursor: pointer; color: var(--accent); font-size: 13.5px; margin-bottom: 6px; }
.scales { margin: 6px 0 0; }
dl.terms { display: grid; grid-template-columns: max-content 1fr; gap: 2px 14px; font-size: 13px; margin: 0 0 14px; }
dl.terms dt { font-family: ui-monospace, "DejaVu Sans Mono", monospace; font-size: 12.5px; }
dl.terms dd { margin: 0; color: var(--muted); }
code, pre { font-family: ui-monospace, SFMono-Regular, Menlo, "DejaVu Sans Mono", monospace; font-size: 12.5px; }
pre { background: var(--soft); border: 1px solid var(--rule); border-radius: 8px; padding: 14px 16px; overflow-x: auto;
  max-height: 560px; margin: 8px 0 0; }
.keys th { color: var(--muted); white-space: nowrap; }
.keys code { overflow-wrap: anywhere; }
footer { color: var(--muted); font-size: 12.5px; margin-top: 48px; border-top: 1px solid var(--rule);
  padding-top: 14px; }
@media (max-width: 760px) { main, header > div { padding-left: 16px; padding-right: 16px; }
  .triple, .pictures { grid-template-columns: 1fr; } }
@media print { nav { display: none; } .tall, pre { max-height: none; } section { break-inside: avoid-page; } }
"""
