// Compiles WGSL files with Tint, the compiler of Chrome and Edge: it holds rules of the standard that naga does not. No GPU driver is needed.
// `npm install webgpu`, then `node tint.mjs FILE…`; the exit status is 1 if a file is refused.
import fs from 'node:fs';
import { createRequire } from 'node:module';
import { pathToFileURL } from 'node:url';

const require = createRequire(`${process.cwd()}/`);
const { create, globals } = await import(pathToFileURL(require.resolve('webgpu')));
Object.assign(globalThis, globals);
const gpu = create(['backend=null']);
const adapter = await gpu.requestAdapter();
const device = await adapter.requestDevice();
let refused = 0;
for (const file of process.argv.slice(2)) {
    device.pushErrorScope('validation');
    const module = device.createShaderModule({ code: fs.readFileSync(file, 'utf8') });
    const { messages } = await module.getCompilationInfo();
    await device.popErrorScope();
    const errors = messages.filter((message) => message.type === 'error');
    for (const { lineNum, message } of errors) console.log(`${file}:${lineNum}: ${message}`);
    refused += errors.length > 0;
}
console.log(`Tint: ${process.argv.length - 2} shaders, ${refused} refused`);
process.exit(refused ? 1 : 0);
