// What a reader sees who moves the slider, points at a curve and chooses.
const at = (id) => document.getElementById(id);
const rows = () =>
  document.querySelectorAll('#chart-distribution .mark-text.role-mark text').length;
const charts = document.querySelectorAll('.chart svg').length;
const before = at('chart-distribution').textContent;
at('moment').value = 0;
at('moment').dispatchEvent(new Event('input', {bubbles: true}));
await until(() => at('moment-said').textContent.startsWith('0 env'));
await until(() => at('chart-distribution').textContent !== before);
const shown = rows(), svg = document.querySelector('#chart-curves svg');
svg.scrollIntoView({block: 'center', behavior: 'instant'});
const box = svg.getBoundingClientRect();
const [x, y] = [box.x + box.width / 2, box.y + box.height / 2];
await until(() => {
  for (const type of ['pointerover', 'pointermove', 'mouseover', 'mousemove'])
    document.elementFromPoint(x, y).dispatchEvent(
      new PointerEvent(type, {bubbles: true, clientX: x, clientY: y}));
  return document.querySelector('#vg-tooltip-element.visible');
});
const told = at('vg-tooltip-element').innerText;
document.querySelector('[data-choose="1"]').click();
await until(() => rows() === 1);
at('log-x').click();
at('log-y').click();
document.querySelector('details.data summary').click();
await until(() => document.querySelectorAll('details.data[open] tbody tr').length > 20);
await resize(390);
return [charts, shown, told, document.documentElement.scrollWidth]
