// Videos play while they are in sight, a click stops and starts them; the bar in the chart below each shows where
// it is, a click there goes there.
const seen = new IntersectionObserver(entries => {
  for (const entry of entries) entry.isIntersecting ? entry.target.play().catch(() => {}) : entry.target.pause();
}, {threshold: 0.25});
for (const watch of document.querySelectorAll('.watch')) {
  const video = watch.querySelector('video'), chart = watch.querySelector('svg'), head = chart.querySelector('.head');
  const frames = Number(chart.dataset.frames), fps = Number(chart.dataset.fps), width = chart.viewBox.baseVal.width;
  const follow = () => {
    const share = Math.min(1, video.currentTime * fps / frames);
    head.setAttribute('transform', `translate(${width * share} 0)`);
    if (!video.paused) requestAnimationFrame(follow);
  };
  video.addEventListener('play', follow);
  video.addEventListener('seeked', follow);
  video.addEventListener('click', () => video.paused ? video.play() : video.pause());
  chart.addEventListener('click', event => {
    video.pause();
    const box = chart.getBoundingClientRect();
    video.currentTime = (event.clientX - box.left) / box.width * frames / fps;
  });
  seen.observe(video);
}
