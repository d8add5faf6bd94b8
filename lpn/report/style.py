"""The style sheet of a report: light on paper and by default, dark on a screen that asks for it."""

STYLE = """
:root{--ink:#1b1e22;--dim:#5b626a;--line:#d5d9de;--soft:#f4f5f7;--paper:#fff;--true:#a87400;--truefill:#f2b705;
--false:#2456c8;--falsefill:#4678f0;--constant:#8a9099;color-scheme:light}
@media screen and (prefers-color-scheme:dark){:root{--ink:#eceef0;--dim:#a3a9b1;--line:#3b4046;--soft:#24272c;
--paper:#16181b;--true:#ffc81e;--truefill:#ffc81e;--false:#86abff;--constant:#8a9099;color-scheme:dark}}
*{box-sizing:border-box;-webkit-print-color-adjust:exact;print-color-adjust:exact}
body{margin:0 auto;padding:28px 24px 60px;max-width:1000px;background:var(--paper);color:var(--ink);
font:14px/1.45 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,"DejaVu Sans",sans-serif}
h1{font-size:27px;line-height:1.2;margin:0 0 2px}h2{font-size:22px;line-height:1.25;margin:0}
h3{font-size:14px;margin:20px 0 6px;padding-bottom:3px;border-bottom:1px solid var(--line)}
p{margin:4px 0}a{color:var(--false)}.dim{color:var(--dim)}.num,td,svg{font-variant-numeric:tabular-nums}
small,.note{font-size:12px;color:var(--dim)}.true{color:var(--true)}
.false{color:var(--false)}.unknown{color:var(--dim)}svg{display:block;width:100%;height:auto;font-size:12px}
svg text{fill:var(--ink)}svg .strong{font-weight:650}svg .on{fill:#141414;font-size:11px}
svg .ground{fill:var(--soft)}svg .constant{fill:var(--constant)}
svg .axis{stroke:var(--line);fill:none}svg .join{stroke:var(--dim);fill:none}
svg .mark{stroke:var(--ink);stroke-width:2.5}svg rect.true{fill:var(--truefill)}
svg rect.false{fill:var(--falsefill)}svg .followed{stroke:var(--ink);stroke-width:2.6}
svg .rivals{stroke:var(--dim);stroke-width:1.6;stroke-dasharray:3 3}
svg .best{fill:none;stroke:var(--true);stroke-width:2.5}.figures{display:flex;flex-wrap:wrap;gap:10px;margin:14px 0}
.figures div{background:var(--soft);border-radius:8px;padding:8px 16px;min-width:88px}
.figures b{display:block;font-size:22px;line-height:1.25}table{border-collapse:collapse;width:100%}
th{font-weight:500;color:var(--dim);text-align:left;font-size:12px;vertical-align:bottom}
th,td{padding:3px 8px 3px 0}td.r,th.r{text-align:right}tbody tr{border-top:1px solid var(--line)}
.figures small{display:block}.contents img,.ranked img{display:block;width:46px;height:46px;object-fit:cover;
border-radius:4px}.sign{display:inline-block;min-width:1.1em;font-weight:700}
.facts{display:grid;grid-template-columns:max-content 1fr;gap:2px 16px;margin:12px 0}
.facts dt{color:var(--dim)}.facts dd{margin:0;overflow-wrap:anywhere}
.case{margin-top:44px;padding-top:18px;border-top:3px solid var(--ink)}
.head{display:flex;justify-content:space-between;align-items:baseline;gap:16px}
.verdict{border-left:6px solid;padding:6px 14px;margin:10px 0;background:var(--soft);border-radius:0 8px 8px 0;
color:var(--ink)}.verdict.true{border-color:var(--truefill)}.verdict.false{border-color:var(--falsefill)}
.verdict.unknown{border-color:var(--constant)}.verdict b{font-size:17px}
.verdict p:first-of-type{font-size:15px}.chips{display:flex;flex-wrap:wrap;gap:4px 6px;margin:8px 0}
.chips span{border:1px solid var(--line);border-radius:12px;padding:0 9px;font-size:12px}
.chips i{font-style:normal;color:var(--dim)}.three{display:grid;grid-template-columns:repeat(3,1fr);gap:14px}
.two{display:grid;grid-template-columns:1fr 1fr;gap:10px 28px}
.pair{display:grid;grid-template-columns:1fr 1fr;gap:8px}figure{margin:0}
figure img{display:block;width:100%;border-radius:4px}.framed img{border:5px solid var(--line)}
.framed.true img{border-color:var(--truefill)}.framed.false img{border-color:var(--falsefill)}
figcaption{font-size:13px;line-height:1.35;margin-top:4px;color:var(--ink)}
figcaption b{font-size:14px}.pair figcaption{font-size:12px;color:var(--dim)}
.legend{display:flex;flex-wrap:wrap;gap:2px 16px;margin:6px 0;font-size:12px;color:var(--dim);align-items:center}
.legend i{display:inline-block;width:11px;height:11px;margin-right:5px;vertical-align:-1px}
.legend img{display:inline-block;width:120px;height:10px;margin:0 6px}
.legend .line{height:0;border-top:3px solid var(--ink);width:20px;vertical-align:3px}
.legend .dash{border-top:2px dashed var(--dim)}.ranked td{vertical-align:middle}
.ranked td.bar{width:46%}.ranked img{border:3px solid var(--line)}
.ranked img.true{border-color:var(--truefill)}.ranked img.false{border-color:var(--falsefill)}
.ranked tr.gap td{border-top:2px dashed var(--dim)}.falls td{padding-top:0;padding-bottom:0}
.falls tbody tr{border:0}.falls .fall{width:42%;text-align:center}
.falls tr.sum td{font-weight:650;border-top:1px solid var(--line)}
.swatch{display:inline-block;width:10px;height:10px;margin-right:6px}
.wide-pictures .three,.wide-pictures .pair{grid-template-columns:1fr}.wide-pictures .three{max-width:640px}
@page{size:A4;margin:11mm 12mm}
@media print{
body{max-width:none;padding:0;font-size:12px}h1{font-size:23px}h2{font-size:19px}
h3{font-size:13px;margin:11px 0 4px;break-after:avoid}
a{color:inherit;text-decoration:none}.back{display:none}.case{break-before:page;margin:0;padding-top:8px}
figure,tr,.keep,.verdict,.chips{break-inside:avoid}thead{display:table-header-group}
.figures div{padding:5px 12px}.verdict{margin:6px 0;padding:4px 12px}figcaption{font-size:11.5px}
.contents img{width:34px;height:34px}.contents td{padding-top:1px;padding-bottom:1px}}
@media screen and (max-width:640px){
body{padding:16px 12px 40px}.two{grid-template-columns:1fr}.three{gap:6px}.framed img{border-width:3px}
.wide{overflow-x:auto}.ranked,.falls{min-width:560px}}
"""
