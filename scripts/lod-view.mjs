// Draws a SOG or a streamed map in PlayCanvas' engine, headless: `npm install playcanvas puppeteer-core`, then
// `node lod-view.mjs MAP.sog|FOLDER/lod-meta.json OUT.png EYE TARGET [lodBaseDistance]`; points are x,y,z in the map's axes. CHROMIUM names the browser.
// Prints the Gaussians drawn and the pieces loaded; the exit status is 1 if the console has an error.
import fs from 'node:fs';
import http from 'node:http';
import { createRequire } from 'node:module';
import path from 'node:path';
import { pathToFileURL } from 'node:url';

const [map, out, eye, target, base = '5'] = process.argv.slice(2);
const require = createRequire(`${process.cwd()}/`);
const puppeteer = (await import(pathToFileURL(require.resolve('puppeteer-core')))).default;
const engine = path.resolve('node_modules/playcanvas/build/playcanvas.mjs');
// Graphics have y up and z backward.
const turned = (point) => point.split(',').map((value, axis) => (axis ? -value : +value));
const page = `<link rel="icon" href="data:,"><body style="margin:0"><canvas id="canvas"></canvas><script type="module">
import * as pc from '/engine.mjs';
const canvas = document.getElementById('canvas');
const device = await pc.createGraphicsDevice(canvas, { deviceTypes: ['webgl2'], antialias: false });
const options = new pc.AppOptions();
options.graphicsDevice = device;
options.componentSystems = [pc.CameraComponentSystem, pc.GSplatComponentSystem];
options.resourceHandlers = [pc.TextureHandler, pc.GSplatHandler];
const app = new pc.AppBase(canvas);
app.init(options);
app.setCanvasFillMode(pc.FILLMODE_NONE, 800, 600);
app.setCanvasResolution(pc.RESOLUTION_FIXED, 800, 600);
app.scene.gsplat.splatBudgetMode = pc.GSPLAT_BUDGET_LIMIT;
const camera = new pc.Entity();
camera.addComponent('camera', { clearColor: new pc.Color(0, 0, 0), fov: 45, nearClip: 0.05, farClip: 1000 });
camera.setPosition(...${JSON.stringify(turned(eye))});
camera.lookAt(new pc.Vec3(...${JSON.stringify(turned(target))}), pc.Vec3.UP);
app.root.addChild(camera);
const asset = new pc.Asset('map', 'gsplat', { url: '/map/${path.basename(map)}' });
asset.on('error', (error) => console.error(error));
asset.ready(() => {
    const entity = new pc.Entity();
    entity.setEulerAngles(180, 0, 0);
    entity.addComponent('gsplat', { asset, unified: true });
    Object.assign(entity.gsplat, { lodBaseDistance: ${Number(base)}, lodMultiplier: 2 });
    app.root.addChild(entity);
});
app.assets.add(asset);
app.assets.load(asset);
app.on('update', () => { window.drawn = app.stats.frame.gsplats; });
app.start();
</script>`;
const types = { '.mjs': 'text/javascript', '.json': 'application/json', '.webp': 'image/webp' };
const pieces = new Set();
const server = http.createServer((request, response) => {
    const url = decodeURIComponent(request.url);
    if (url === '/') return response.writeHead(200, { 'content-type': 'text/html' }).end(page);
    const file = url === '/engine.mjs' ? engine : path.join(path.dirname(map), url.slice('/map/'.length));
    if (file.endsWith('meta.json')) pieces.add(path.relative(path.dirname(map), file));
    if (!fs.existsSync(file)) return response.writeHead(404).end();
    response.writeHead(200, { 'content-type': types[path.extname(file)] ?? 'application/octet-stream' }).end(fs.readFileSync(file));
}).listen(0, '127.0.0.1');
const args = ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader'];
const browser = await puppeteer.launch({ executablePath: process.env.CHROMIUM ?? '/usr/bin/chromium', args });
const tab = await browser.newPage();
await tab.setViewport({ width: 800, height: 600 });
const errors = [];
tab.on('console', (message) => message.type() === 'error' && errors.push(message.text()));
tab.on('pageerror', (error) => errors.push(error.message));
await tab.goto(`http://127.0.0.1:${server.address().port}/`);
// Until the number drawn has not changed for some seconds.
for (let same = 0, drawn = 0, looks = 0; same < 6 && looks < 60; looks += 1) {
    await new Promise((resolve) => setTimeout(resolve, 700));
    const now = await tab.evaluate(() => window.drawn ?? 0);
    same = now > 0 && now === drawn ? same + 1 : 0;
    drawn = now;
}
await tab.screenshot({ path: out });
console.log(`${await tab.evaluate(() => window.drawn)} Gaussians drawn; ${[...pieces].join(', ')}; errors: ${errors.join('; ') || 'none'}`);
await browser.close();
server.close();
process.exit(errors.length ? 1 : 0);
