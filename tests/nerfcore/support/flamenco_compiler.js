// What Flamenco's job compiler gives to a script, as its author and globals modules do (Flamenco 3), for node.
// node flamenco_compiler.js SCRIPT SETTINGS.json → the authored job as JSON.
const fs = require("fs");
const vm = require("vm");

const SETTING_TYPES = ["string", "int32", "float", "bool"];
const SUBTYPES = ["file_path", "dir_path", "file_name", "hashed_file_path"];
const VISIBILITIES = ["visible", "hidden", "submission", "web"];

let count = 0;
const author = {
    Task(name, type) {
        if (!name.trim() || !type.trim()) throw new Error("author.Task(name, type): both are required");
        const task = { uuid: `${count++}`, name: name.trim(), type: type.trim(), commands: [], dependencies: [] };
        task.addCommand = (command) => { task.commands.push(command); };
        task.addDependency = (other) => { task.dependencies.push(other.name); };
        return task;
    },
    Command(name, parameters) {
        if (typeof name !== "string" || typeof parameters !== "object") throw new Error("author.Command(name, parameters)");
        return { name, parameters };
    },
};

function explode(range) {
    const frames = new Set();
    for (const part of range.replaceAll("..", "-").split(",")) {
        const ends = part.split("-").map((text) => {
            if (!/^\s*\d+\s*$/.test(text)) throw new Error(`invalid range "${range}"`);
            return parseInt(text.trim(), 10);
        });
        if (ends.length > 2) throw new Error(`invalid range "${range}"`);
        for (let frame = ends[0]; frame <= ends[ends.length - 1]; frame++) frames.add(frame);
    }
    return [...frames].sort((a, b) => a - b);
}

function merge(frames) {
    const found = [];
    let start = frames[0];
    frames.forEach((frame, index) => {
        if (frames[index + 1] === frame + 1) return;
        // Two frames are written as such, more as a range.
        if (frame === start) found.push(`${frame}`);
        else if (frame === start + 1) found.push(`${start}`, `${frame}`);
        else found.push(`${start}-${frame}`);
        start = frames[index + 1];
    });
    return found.join(",");
}

function frameChunker(range, size) {
    if (!range.trim() || size < 1) throw new Error("empty range or chunk size");
    const frames = explode(range);
    const chunks = [];
    for (let i = 0; i < frames.length; i += size) chunks.push(merge(frames.slice(i, i + size)));
    return chunks;
}

const tasks = [];
const job = { settings: JSON.parse(fs.readFileSync(process.argv[3], "utf-8")), addTask: (task) => { tasks.push(task); } };
const world = vm.createContext({ author, frameChunker, print() {}, job });
vm.runInContext(fs.readFileSync(process.argv[2], "utf-8"), world);
const type = vm.runInContext("JOB_TYPE", world);
for (const setting of type.settings) {
    if (!SETTING_TYPES.includes(setting.type)) throw new Error(`type ${setting.type}`);
    if (setting.subtype && !SUBTYPES.includes(setting.subtype)) throw new Error(`subtype ${setting.subtype}`);
    if (setting.visible && !VISIBILITIES.includes(setting.visible)) throw new Error(`visible ${setting.visible}`);
    if (!(setting.key in job.settings) && "default" in setting) job.settings[setting.key] = setting.default;
    if (setting.required && !(setting.key in job.settings)) throw new Error(`${setting.key} is required`);
}
vm.runInContext("compileJob(job)", world);
process.stdout.write(JSON.stringify({ label: type.label, settings: type.settings, tasks }));
