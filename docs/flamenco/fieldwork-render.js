// SPDX-License-Identifier: GPL-3.0-or-later
// Flamenco job type: frames of a trained field, in parts, by `blender -b -c fieldwork render`.
// Copy it into the folder `scripts` beside Flamenco Manager. Workers need Blender with the Fieldwork extension and its
// engine, and see the project at the same place.

const JOB_TYPE = {
    label: "Fieldwork Render",
    description: "Render frames of a trained field with the Fieldwork extension",
    settings: [
        { key: "frames", type: "string", required: true, eval: "f'0-{C.scene.frame_end - C.scene.frame_start}'",
          description: "Frames, counted from 0. Examples: '47', '0-99', '3, 5-10'" },
        { key: "chunk_size", type: "int32", default: 20, visible: "submission",
          description: "Number of frames that one task renders" },
        { key: "project", type: "string", subtype: "dir_path", required: true,
          eval: "bpy.path.abspath(C.scene.fieldwork.project)", description: "Project folder, as the workers see it" },
        { key: "run", type: "string", default: "main", description: "Name of the run" },
        { key: "camera", type: "string", subtype: "file_path", required: true,
          description: "transforms.json with a camera for each frame" },
        { key: "render_output_path", type: "string", subtype: "dir_path", required: true,
          description: "Folder for the pictures, as the workers see it" },
        { key: "passes", type: "string", default: "rgb,depth,semantic", description: "Passes, separated by commas" },
        { key: "baked", type: "bool", default: false, description: "Render the baked field, which is faster" },
        { key: "whole", type: "bool", default: true,
          description: "At the end look whether every camera's frame is there, and render what is missing" },
    ]
};

function compileJob(job) {
    const settings = job.settings;
    const parts = [];
    for (const chunk of frameChunker(settings.frames, settings.chunk_size)) {
        const task = author.Task(`render-${chunk}`, "blender");
        for (const [first, last] of ranges(chunk)) {
            task.addCommand(render(settings, ["--frame-range", `${first}`, `${last}`]));
        }
        job.addTask(task);
        parts.push(task);
    }
    if (!settings.whole) {
        return;
    }
    // Keeps what the parts have made, renders what is missing, and notes what all of it was made from.
    const whole = author.Task("check-all-frames", "blender");
    whole.addCommand(render(settings, []));
    for (const part of parts) {
        whole.addDependency(part);
    }
    job.addTask(whole);
}

// A chunk like "3-8,13" as pairs of first and last frame.
function ranges(chunk) {
    return chunk.split(",").map(function (part) {
        const ends = part.split("-");
        return [parseInt(ends[0], 10), parseInt(ends[ends.length - 1], 10)];
    });
}

function render(settings, range) {
    const args = [
        "-b", "-c", "fieldwork", "render", settings.project,
        "--run", settings.run,
        "--out", settings.render_output_path,
        "--camera", settings.camera,
        "--passes", settings.passes,
    ];
    if (settings.baked) {
        args.push("--baked");
    }
    return author.Command("exec", { exe: "{blender}", args: args.concat(range) });
}
