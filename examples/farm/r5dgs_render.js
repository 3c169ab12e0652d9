// Flamenco 3 job type: render frames of a .blend with the R5DGS engine.
// Copy it into the folder `scripts` beside the program flamenco-manager, and restart the manager.

const JOB_TYPE = {
    label: "R5DGS Render",
    description: "Renders frames with the R5DGS engine. Frames that exist are left.",
    settings: [
        { key: "frames", type: "string", required: true,
          eval: "f'{C.scene.frame_start}-{C.scene.frame_end}'",
          evalInfo: { showLinkButton: true, description: "Scene frame range" },
          description: "Frames to render, such as '47', '1-30' or '3, 5-10, 47-327'" },
        { key: "chunk_size", type: "int32", default: 10, propargs: { min: 1 }, visible: "submission",
          description: "Number of frames of a task" },
        { key: "render_output_root", type: "string", subtype: "dir_path", required: true, visible: "submission",
          description: "Folder in which the folder of the job is created" },
        { key: "render_output_path", type: "string", subtype: "file_path", editable: false,
          eval: "str(Path(abspath(settings.render_output_root), jobname, '{timestamp}', '######'))",
          description: "Path of the frames" },
        { key: "blendfile", type: "string", required: true, visible: "web", description: "File to render" },
    ],
};

function compileJob(job) {
    const settings = job.settings;
    if (!settings.render_output_path) {
        throw "the setting render_output_path is empty";
    }
    // Stored in the settings, so that the manager shows the real path.
    settings.render_output_path = settings.render_output_path.replace("{timestamp}", formatTimestampLocal(job.created));
    for (const chunk of frameChunker(settings.frames, settings.chunk_size)) {
        const task = author.Task(`render-${chunk}`, "blender");
        task.addCommand(author.Command("blender-render", {
            exe: "{blender}",
            exeArgs: "{blenderArgs}",
            argsBefore: [],
            blendfile: settings.blendfile,
            // The notation of Blender for ranges is 1..10.
            args: [
                "--render-output", settings.render_output_path,
                "--command", "r5dgs_render", "--frames", chunk.replaceAll("-", ".."),
            ],
        }));
        job.addTask(task);
    }
}
