// What overflows on screens of three widths, and when the page is printed.
const found = [];
const drawn = () => document.querySelector('#chart-curves svg').getAttribute('width');
for (const width of [1280, 700, 390]) {
  await resize(width);
  found.push(OVERFLOW);
  // The window's event of its new width may come late, and draws for the screen again.
  await until(() => drawn() === '780' || !dispatchEvent(new Event('beforeprint')));
  found.push(OVERFLOW);
  dispatchEvent(new Event('afterprint'));
  const whole = String(document.querySelector('figure').clientWidth);
  await until(() => drawn() === whole);
}
return found
