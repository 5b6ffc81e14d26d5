/*
 * kitchen.c: a controller in C. MuJoCo's own C interface is the plant, liblads the policy; they meet once every control period.
 *
 *     kitchen IMAGE SCENE INSTRUCTION [--fast] [--steps N]
 *
 * IMAGE is made by `lads compile`, SCENE is the kitchen's kitchen_env_model.xml, INSTRUCTION an id or a text that the policy
 * knows. Prints each sub-task when it is done. The exit status is 0 when all that the instruction asks for were done, 1 when not
 * all were, 2 when something was refused. Without --fast it keeps the policy's control period in real time.
 */
#define _POSIX_C_SOURCE 200809L

#include "files.h"

#include <lads.h>
#include <mujoco/mujoco.h>

#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { OBSERVATION_LEN = 30, ACTION_LEN = 9, SUB_TASKS = 7, GOAL_MOST = 7, EPISODE_STEPS = 280, NS_PER_S = 1000000000 };

static const double SET_POINT_LOW[ACTION_LEN] = {-2.9, -1.8, -2.9, -3.1, -2.9, 0.0, -2.9, 0.0, 0.0};
static const double SET_POINT_HIGH[ACTION_LEN] = {2.9, 1.8, 2.9, 0.0, 2.9, 3.8, 2.9, 0.04, 0.04};

static const double START[OBSERVATION_LEN] = {
    1.48388023e-01,  -1.76848573e+00, 1.84390296e+00,  -2.47685760e+00, 2.60252026e-01,  7.12533105e-01,
    1.59515394e+00,  4.79267505e-02,  3.71350919e-02,  -2.66279850e-04, -5.18043486e-05, 3.12877220e-05,
    -4.51199853e-05, -3.90842156e-06, -4.22629655e-05, 6.28065475e-05,  4.04984708e-05,  4.62730939e-04,
    -2.26906415e-04, -4.65501369e-04, -6.44129196e-03, -1.77048263e-03, 1.08009684e-03,  -2.69397440e-01,
    3.50383255e-01,  1.61944683e+00,  1.00618764e+00,  4.06395120e-03,  -6.62095997e-03, -2.68278933e-04};

/* A sub-task is done when its elements of the state are nearer to the goal than 0.3. */
static const struct {
    const char *name;
    char letter; /* in the id of an instruction */
    int first, len;
    double goal[GOAL_MOST];
} TASKS[SUB_TASKS] = {
    {"microwave", 'm', 22, 1, {-0.75}},
    {"kettle", 'k', 23, 7, {-0.23, 0.75, 1.62, 0.99, 0.0, 0.0, -0.06}},
    {"bottom burner", 'b', 11, 2, {-0.88, -0.01}},
    {"top burner", 't', 15, 2, {-0.92, -0.01}},
    {"light switch", 'l', 17, 2, {-0.69, -0.05}},
    {"slide cabinet", 's', 19, 1, {0.37}},
    {"hinge cabinet", 'h', 20, 2, {0.0, 1.45}},
};

static bool is_done(int task, const mjtNum *state) {
    double sum = 0.0;
    for (int i = 0; i < TASKS[task].len; i++) {
        const double distance = state[TASKS[task].first + i] - TASKS[task].goal[i];
        sum += distance * distance;
    }
    return sqrt(sum) < 0.3;
}

static int refuse(const char *thing, const char *why) {
    fprintf(stderr, "kitchen: %s: %s\n", thing, why);
    return 2;
}

/* The next moment of a clock that ticks once a period; returns how many periods have been missed. */
static unsigned next_period(struct timespec *next, long period_ns) {
    struct timespec now;
    unsigned missed = 0;
    clock_gettime(CLOCK_MONOTONIC, &now);
    for (;;) {
        next->tv_nsec += period_ns % NS_PER_S;
        next->tv_sec += period_ns / NS_PER_S + next->tv_nsec / NS_PER_S;
        next->tv_nsec %= NS_PER_S;
        if (next->tv_sec > now.tv_sec || (next->tv_sec == now.tv_sec && next->tv_nsec > now.tv_nsec)) {
            break;
        }
        missed++;
    }
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, next, NULL) != 0) {
    }
    return missed;
}

/* Whether the contract is the one that this program was written for: lengths, order of the joints, period. */
static const char *misfit(const lads_policy *policy, const lads_contract *contract, const mjModel *model) {
    if (contract->observation_len != OBSERVATION_LEN || contract->action_len != ACTION_LEN || model->nq != OBSERVATION_LEN ||
        model->nu != ACTION_LEN) {
        return "the policy is not one for the kitchen";
    }
    for (size_t i = 0; i < OBSERVATION_LEN; i++) {
        lads_element element = {.struct_bytes = sizeof element};
        char joint[64];
        lads_channel_element(policy, contract->observation, i, &element);
        snprintf(joint, sizeof joint, "%.*s", (int)element.joint.len, element.joint.data);
        const int id = mj_name2id(model, mjOBJ_JOINT, joint);
        /* The kettle's free joint has seven positions. */
        const size_t free_len = id >= 0 && model->jnt_type[id] == mjJNT_FREE ? 7 : 1;
        if (id < 0 || i < (size_t)model->jnt_qposadr[id] || i >= (size_t)model->jnt_qposadr[id] + free_len) {
            return "an element of the observation belongs to another joint of the scene";
        }
    }
    return NULL;
}

int main(int count, char **arguments) {
    static lads_policy policy;
    lads_contract contract = {.struct_bytes = sizeof contract};
    lads_controller *controller;
    lads_instruction instruction = {.struct_bytes = sizeof instruction};
    lads_report report = {.struct_bytes = sizeof report};
    lads_status status;
    uint32_t number;
    bool fast = false;
    long steps = EPISODE_STEPS;
    if (count < 4) {
        return refuse("usage", "kitchen IMAGE SCENE INSTRUCTION [--fast] [--steps N]");
    }
    for (int i = 4; i < count; i++) {
        if (strcmp(arguments[i], "--fast") == 0) {
            fast = true;
        } else if (strcmp(arguments[i], "--steps") == 0 && i + 1 < count) {
            steps = strtol(arguments[++i], NULL, 10);
        } else {
            return refuse(arguments[i], "unknown argument");
        }
    }

    /* Everything that can be refused, and all memory, before the loop. */
    size_t image_bytes = 0;
    unsigned char *image = read_file(arguments[1], &image_bytes);
    if (image == NULL) {
        return refuse(arguments[1], "cannot be read");
    }
    if ((status = lads_policy_open(image, image_bytes, &policy)) != LADS_STATUS_OK) {
        return refuse(arguments[1], lads_status_text(status));
    }
    lads_policy_contract(&policy, &contract);
    status = lads_policy_find_instruction(&policy, arguments[3], strlen(arguments[3]), &number);
    if (status != LADS_STATUS_OK) {
        return refuse(arguments[3], lads_status_text(status));
    }
    lads_policy_instruction(&policy, number, &instruction);

    char error[1000] = "";
    mjModel *model = mj_loadXML(arguments[2], NULL, error, sizeof error);
    if (model == NULL) {
        return refuse(arguments[2], error);
    }
    const char *wrong = misfit(&policy, &contract, model);
    if (wrong != NULL) {
        return refuse(arguments[1], wrong);
    }
    mjData *data = mj_makeData(model);

    /* A robot that hears nothing new keeps doing what it does for a moment, then comes to rest. */
    const lads_options options = {.struct_bytes = sizeof options,
                                  .fallback = LADS_FALLBACK_DECAY,
                                  .decay_s = 2 * contract.control_period_s,
                                  .late_after = 1,
                                  .coast = 1,
                                  .stop_after = 25,
                                  .max_jump = 10}; /* periods: further ahead, and a timestamp is damaged */
    const size_t workspace_bytes = lads_workspace_bytes(&policy);
    void *workspace = lines(workspace_bytes);
    if (data == NULL || workspace == NULL) {
        return refuse("memory", "there is not enough");
    }
    if ((status = lads_controller_init(&policy, workspace, workspace_bytes, &options, &controller, NULL)) != LADS_STATUS_OK ||
        (status = lads_self_test(controller, NULL)) != LADS_STATUS_OK ||
        (status = lads_set_instruction(controller, number)) != LADS_STATUS_OK) {
        return refuse(arguments[1], lads_status_text(status));
    }

    memcpy(data->qpos, START, sizeof START);
    mj_forward(model, data);
    const long period_ns = lround(1e9 * (double)contract.control_period_s);
    const int physics_steps = (int)lround((double)contract.control_period_s / model->opt.timestep);
    bool done[SUB_TASKS] = {false};
    int left = 0;
    bool asked[SUB_TASKS];
    for (int task = 0; task < SUB_TASKS; task++) {
        asked[task] = memchr(instruction.id.data, TASKS[task].letter, instruction.id.len) != NULL;
        left += asked[task];
    }
    printf("%.*s\n", (int)instruction.text.len, instruction.text.data);

    /* What an action means the contract says: rad/s (fingers: m/s) that an element of 1 asks for, from the observed position on. */
    double velocity_scale[ACTION_LEN], velocity_offset[ACTION_LEN];
    for (size_t i = 0; i < ACTION_LEN; i++) {
        lads_element element = {.struct_bytes = sizeof element};
        lads_channel_element(&policy, contract.action, i, &element);
        velocity_scale[i] = (double)element.scale;
        velocity_offset[i] = (double)element.offset;
    }

    struct timespec next;
    clock_gettime(CLOCK_MONOTONIC, &next);
    float observation[OBSERVATION_LEN], action[ACTION_LEN];
    for (long step = 1; step <= steps && left > 0; step++) {
        lads_tick tick = {.struct_bytes = sizeof tick, .timestamp = (uint64_t)step};
        if (!fast) {
            tick.missed = next_period(&next, period_ns);
        }
        for (int i = 0; i < OBSERVATION_LEN; i++) {
            observation[i] = (float)data->qpos[i];
        }
        status = lads_step(controller, observation, OBSERVATION_LEN, &tick, action, ACTION_LEN, &report);
        if (status != LADS_STATUS_OK) {
            fprintf(stderr, "kitchen: step %ld: %s", step, lads_status_text(status));
            if (report.element != LADS_NONE) {
                fprintf(stderr, " (element %u)", (unsigned)report.element);
            }
            fputc('\n', stderr);
        }
        for (int i = 0; i < ACTION_LEN; i++) {
            const double velocity = velocity_offset[i] + velocity_scale[i] * (double)action[i];
            const double wanted = data->qpos[i] + velocity * (double)contract.control_period_s;
            data->ctrl[i] = fmin(fmax(wanted, SET_POINT_LOW[i]), SET_POINT_HIGH[i]);
        }
        for (int i = 0; i < physics_steps; i++) {
            mj_step(model, data);
        }
        for (int task = 0; task < SUB_TASKS; task++) {
            if (!done[task] && is_done(task, data->qpos)) {
                done[task] = true;
                const bool wanted = asked[task];
                left -= wanted;
                printf("%6.2f s  %s%s\n", (double)step * (double)contract.control_period_s, TASKS[task].name,
                       wanted ? "" : " (nobody asked)");
            }
        }
    }

    lads_counters_t counters = {.struct_bytes = sizeof counters};
    lads_counters(controller, &counters);
    printf("%d sub-tasks left; %llu periods, %llu of them the policy's, %llu missed\n", left,
           (unsigned long long)counters.periods, (unsigned long long)counters.policy, (unsigned long long)counters.missed);
    mj_deleteData(data);
    mj_deleteModel(model);
    free(workspace);
    free(image);
    return left > 0;
}
