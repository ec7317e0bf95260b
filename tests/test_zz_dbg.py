import time, numpy as np
from tests import browser, skills
from tests.test_view_browser import *
from matplotlib.image import imsave
def test_it():
    demonstration = skills.few_bottles()[1]
    situation = Situation(demonstration.joints[0], demonstration.frames)
    before, up = situation.frames["bottle"].position.numpy(), np.array((0.0, 0.0, 1.0))
    with LiveView(skills.small_bottle(), [situation], port=0) as view, browser.page(800, 700) as page:
        page.open(view.url); t=time.time()
        draws(page); print('drawn',time.time()-t)
        camera, size = view.scene.server.initial_camera, view.scene.frames["bottle"].scale
        start, end = (seen_at(page, camera, before + d * up) for d in (0.6 * size, 0.6 * size + 0.05))
        print(start,end,size)
        while yellow(page.screenshot()) < 10: page.mouse("mouseMoved", start + time.monotonic() % 2, buttons=0)
        imsave('/tmp/g/d_hover.png',page.screenshot()); print('hover',time.time()-t, yellow(page.screenshot()))
        page.mouse("mousePressed", start); imsave('/tmp/g/d_press.png',page.screenshot())
        for share in np.linspace(0, 1, 6):
            page.mouse("mouseMoved", start + share * (end - start)); print(view.scene.frames["bottle"].position)
        imsave('/tmp/g/d_moved.png',page.screenshot())
        page.mouse("mouseReleased", end, buttons=0)
        print('released',time.time()-t)
        for _ in range(30):
            page.evaluate("1"); time.sleep(.5)
        print(view.scene.frames["bottle"].position, view.situation.frames['bottle'].position)
