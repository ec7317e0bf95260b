// The time line's position is in the page's first input; without one there is no marker. On a
// narrow page the curves would hide the robot: there they begin folded, but on a phone, upright.
(() => {
  document.getElementById('curves').open = innerWidth >= 700 || innerHeight >= 2 * innerWidth;
  const marks = document.querySelectorAll('#curves .now');
  const follow = () => {
    const clock = Math.min(END, parseFloat(document.querySelector('input')?.value));
    for (const mark of marks) {
      mark.setAttribute('visibility', Number.isFinite(clock) ? 'visible' : 'hidden');
      if (Number.isFinite(clock)) mark.setAttribute('transform', `translate(${clock})`);
    }
    requestAnimationFrame(follow);
  };
  follow();
})();
