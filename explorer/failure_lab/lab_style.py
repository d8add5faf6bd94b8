"""How the failure laboratory looks.

Its elements take the width that there is and ask for none (`width:0;min-width:100%`): viser's sheet on a phone would become as
wide as the widest of them, and cut off what stands above.
"""

STYLE = """<style>
.lpn.lab-bar,.lpn.lab-boxes,.lpn.lab-said,.lpn.lab-table,.lpn.lab-note,#lpn-lab-breakdown,#lpn-lab-map{width:0;min-width:100%;
box-sizing:border-box}
.lpn.lab-bar{display:flex;flex-wrap:wrap;gap:.3em .8em;align-items:center}
.lpn .lab-chips{display:flex;flex-wrap:wrap;gap:.25em .35em;align-items:center;margin:.15em 0 .35em}
.lpn .lab-chips a,.lab-said a:not(.pick):not(.link):not(.pager a){cursor:pointer;padding:0 .6em;border:1px solid rgba(128,128,128,.5);border-radius:9px}
.lpn .lab-chips a:hover{background:rgba(128,128,128,.18)}
.lpn .lab-chips a.chosen,.lab-said a.chosen{background:rgba(86,180,233,.3)}
.lpn .seg{display:inline-flex;flex-wrap:wrap;min-width:0;border:1px solid rgba(128,128,128,.5);border-radius:5px;overflow:hidden}
.lpn .seg a{cursor:pointer;padding:1px .7em;white-space:nowrap}
.lpn .seg a+a{border-left:1px solid rgba(128,128,128,.35)}
.lpn .seg a:hover,.lpn .acts a:hover{background:rgba(128,128,128,.18)}
.lpn .seg a.chosen{background:rgba(86,180,233,.3)}
.lab-said .gap{flex:1}
.lab-said .pager a{padding:0 .5em}
.lpn .acts{display:inline-flex;gap:.2em;margin-left:auto}
.lpn .acts a{cursor:pointer;padding:1px .5em;border-radius:4px;white-space:nowrap}
.lpn .acts a.chosen{background:rgba(86,180,233,.3)}
.lpn.lab-boxes,.lpn.lab-note{display:flex;flex-wrap:wrap;gap:.5em;align-items:center;margin-top:.3em}
.lpn input,.lpn textarea{font:inherit;color:inherit;background:rgba(128,128,128,.14);border:1px solid rgba(128,128,128,.4);
border-radius:4px;padding:2px .6em;min-width:0;box-sizing:border-box}
.lpn input:focus,.lpn textarea:focus{outline:none;border-color:#56b4e9}
.lab-boxes input:first-child{flex:1 1 8em}.lab-boxes input:last-child{flex:3 1 16em}
.lab-said .line>*{white-space:nowrap;min-width:0;max-width:100%;overflow:hidden;text-overflow:ellipsis}
.lab-said .line{display:flex;flex-wrap:wrap;gap:.2em .8em;align-items:center;min-height:22px}
.lpn a.link{cursor:pointer;text-decoration:underline dotted}
.lab-said a{cursor:pointer}
.lpn a.pick{background:rgba(86,180,233,.25);border-radius:9px;padding:0 .7em}
.lpn .flaw,.lpn.flaw{color:#ffb35c}
:root[data-mantine-color-scheme=light] .flaw{color:#a04e00}
.lab-said .turn{display:inline-flex;gap:.4em;align-items:center}
.lpn.lab-empty{padding:1.2em .8em}
.lpn.lab-empty .bar{margin-top:.5em;max-width:420px}.lpn.lab-empty .bar i{background:#56b4e9}
.lpn.lab-table{overflow-x:auto}
.lab-table table{white-space:nowrap}
.lab-table thead th{cursor:pointer;border-bottom:1px solid rgba(128,128,128,.5);user-select:none}
.lab-table thead th:hover{background:rgba(128,128,128,.18)}
.lab-table thead th[aria-sort=ascending],.lab-table thead th[aria-sort=descending]{font-weight:650}
.lab-table td,.lab-table th{padding:0 .5em;height:26px;text-align:left}
.lab-table td.number,.lab-table th.number{text-align:right}
.lab-table td.text{max-width:11em;overflow:hidden;text-overflow:ellipsis}
.lab-table tbody tr{cursor:pointer;border-bottom:1px solid rgba(128,128,128,.14)}
.lab-table tbody tr:hover{background:rgba(128,128,128,.16)}
.lab-table tbody tr.chosen{background:rgba(86,180,233,.24)}
.lab-table .pic{padding:0 2px}.lab-table th.pic,.lab-table td.pic:first-child{width:28px}
.lab-table .pic img{width:24px;height:24px;border-radius:3px;vertical-align:middle;margin-right:.4em}
.lab-table td.margin div{position:relative;height:3px;background:rgba(128,128,128,.22);margin-top:-1px}
.lab-table td.margin i{position:absolute;top:0;height:3px}
.lpn .swatch{display:inline-block;width:10px;height:10px;border-radius:2px;margin-right:.45em}
.lpn .lab-cards{columns:320px 3;column-gap:18px}
.lpn .card{break-inside:avoid;margin-bottom:.8em}
.lpn .card .title{font-weight:650;margin-bottom:.15em}
.lpn .line{display:flex}
.lpn .card .line{gap:.6em;align-items:center;cursor:pointer;border-radius:4px;padding:1px 4px}
.lpn .card .line:hover{background:rgba(128,128,128,.16)}
.lpn .card .line.chosen{background:rgba(86,180,233,.24)}
.lpn .card .name{width:9.2em;flex:none;overflow:hidden;text-overflow:ellipsis;white-space:nowrap}
.lpn .card .many{width:3.2em;text-align:right;flex:none}
.lpn .card .track{position:relative;flex:1;height:12px;background:rgba(128,128,128,.14)}
.lpn .card .track i{position:absolute;left:0;top:0;height:12px;background:#4678f0}
.lpn .card .track u{position:absolute;top:-2px;height:16px;width:1px;background:currentColor;opacity:.55}
.lpn .card .track b{position:absolute;top:3px;height:6px;border:solid currentColor;border-width:0 1px;box-sizing:border-box;
background:linear-gradient(currentColor,currentColor) center/100% 1px no-repeat}
.lpn .card .pair{flex:1;display:flex;gap:.5em;align-items:center}
.lpn .card .pair img,.lpn .card .none{width:24px;height:24px;border-radius:3px}
.lpn .lab-map{position:relative;cursor:crosshair;user-select:none;touch-action:none;line-height:0}
.lpn .lab-map img{width:100%;display:block;border-radius:4px}
.lpn .lab-map .drawn{position:absolute;display:none;border:1px solid #fff;outline:1px solid #000;background:rgba(255,255,255,.12);
pointer-events:none;box-sizing:border-box}
.lpn .lab-key{display:flex;flex-wrap:wrap;gap:.1em 1em;margin-top:.2em}
.lpn.lab-tip{position:absolute;z-index:9;display:none;gap:.6em;align-items:center;background:rgba(20,20,20,.94);color:#eee;
border:1px solid rgba(200,200,200,.5);border-radius:5px;padding:5px 8px;pointer-events:none;width:max-content;--lpn-true:#ffc81e;--lpn-false:#86a4ff}
.lab-tip img{width:52px;height:52px;border-radius:3px}
.lab-note b{overflow-wrap:anywhere}.lab-note input{flex:1 1 8em}.lab-note textarea{flex:2 1 12em;resize:vertical;min-height:26px}
.lab-note a{cursor:pointer;padding:1px .7em;border:1px solid rgba(128,128,128,.5);border-radius:4px}
</style>"""
