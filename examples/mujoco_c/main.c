/*
 * A robot program around the supervised law, with MuJoCo in place of the robot: hold, move, take a push, come back,
 * touch a wall, come home. It logs every tick.
 *
 *   arm_in_mujoco SCENE.xml LOG.csv
 *
 * The joints of the scene are joint0, joint1, ..., the motors motor0, ... Push and contact are at body3 and hand.
 * For your robot, replace `read_robot` and `write_robot`, and leave out `disturb`.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <mujoco/mujoco.h>

#include "arm.h"

#define N ARM_JOINTS
#define K ARM_REFERENCE
#define PERIOD 0.001   /* [s] */
#define SMOOTHNESS 4.5 /* poles of the stream of references [1/s] */
#define QUIET 0.05     /* joint speed at which a caught arm counts as at rest [rad/s] ... */
#define PATIENCE 1000  /* ... and for how many ticks, before the program asks for the law again */
#define WAY_HOME 4.0   /* duration of the way to the start after the arm was caught [s] */

/* What the program wants, and when: targets relative to the start. */
typedef struct {
  double time;
  double change[K];
} step;

static const step STEPS[] = {
    {1.0, {-0.03, 0.0, -0.03, 0.0, 0.0, 0.0, 0.0}}, /* the flange moves, xi stays */
    {3.5, {-0.03, 0.0, -0.03, 0.2, 0.0, 0.0, 0.0}}, /* the elbow moves, the flange stays */
    {17.0, {0.05, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0}},    /* 3 cm into the wall */
    {20.0, {0.0}},                                   /* home */
};
#define END 23.0
#define STEP_COUNT (sizeof STEPS / sizeof *STEPS)

/* What happens to the arm. */
#define PUSH_START 7.0
#define PUSH_END 7.5
static const double PUSH[3] = {0.0, 120.0, 0.0}; /* at the elbow, in world axes [N] */

typedef struct {
  mjModel *model;
  mjData *data;
  int position[N], velocity[N], motor[N]; /* addresses of the joints */
  int elbow, hand;
} robot;

/* What the program remembers from tick to tick, besides the state of the law. */
typedef struct {
  double start[K];  /* controlled quantities at the start */
  double target[K]; /* where the reference goes */
  arm_reference reference;
  size_t done;         /* steps that were taken */
  int quiet;           /* ticks for which a caught arm has been at rest */
  arm_reference found; /* where the arm was when the law came back ... */
  double found_time;   /* ... and when that was */
} plan;

static int find(const mjModel *model, int kind, const char *name) {
  const int id = mj_name2id(model, kind, name);
  if (id < 0) {
    fprintf(stderr, "the scene has no %s\n", name);
    exit(2);
  }
  return id;
}

static robot open_robot(const char *scene) {
  char error[500] = "", name[16];
  robot arm;
  int i;
  arm.model = mj_loadXML(scene, NULL, error, sizeof error);
  if (!arm.model) {
    fprintf(stderr, "%s: %s\n", scene, error);
    exit(2);
  }
  arm.data = mj_makeData(arm.model);
  for (i = 0; i < N; ++i) {
    int joint;
    snprintf(name, sizeof name, "joint%d", i);
    joint = find(arm.model, mjOBJ_JOINT, name);
    arm.position[i] = arm.model->jnt_qposadr[joint];
    arm.velocity[i] = arm.model->jnt_dofadr[joint];
    snprintf(name, sizeof name, "motor%d", i);
    arm.motor[i] = find(arm.model, mjOBJ_ACTUATOR, name);
  }
  arm.elbow = find(arm.model, mjOBJ_BODY, "body3");
  arm.hand = find(arm.model, mjOBJ_GEOM, "hand");
  arm.model->opt.timestep = PERIOD;
  return arm;
}

static void place_robot(robot *arm, const double q[N]) {
  int i;
  for (i = 0; i < N; ++i) arm->data->qpos[arm->position[i]] = q[i];
  mj_forward(arm->model, arm->data);
}

static void read_robot(const robot *arm, double q[N], double dq[N]) {
  int i;
  for (i = 0; i < N; ++i) {
    q[i] = arm->data->qpos[arm->position[i]];
    dq[i] = arm->data->qvel[arm->velocity[i]];
  }
}

static void write_robot(robot *arm, const double torque[N]) {
  int i;
  for (i = 0; i < N; ++i) arm->data->ctrl[arm->motor[i]] = torque[i];
  mj_step(arm->model, arm->data);
}

/* Push at the elbow. Returns the force [N]. */
static double disturb(robot *arm, double time) {
  const int pushed = time >= PUSH_START && time < PUSH_END;
  int i;
  for (i = 0; i < 3; ++i) arm->data->xfrc_applied[6 * arm->elbow + i] = pushed ? PUSH[i] : 0.0;
  return pushed ? sqrt(PUSH[0] * PUSH[0] + PUSH[1] * PUSH[1] + PUSH[2] * PUSH[2]) : 0.0;
}

/* Force of the wall on the hand [N]. */
static double contact(const robot *arm) {
  double total = 0.0, force[6];
  int k;
  for (k = 0; k < arm->data->ncon; ++k) {
    mj_contactForce(arm->model, arm->data, k, force);
    if (arm->data->contact[k].geom[0] == arm->hand || arm->data->contact[k].geom[1] == arm->hand) total += force[0];
  }
  return total;
}

static double fastest(const double dq[N]) {
  double speed = 0.0;
  int i;
  for (i = 0; i < N; ++i) speed = fmax(speed, fabs(dq[i]));
  return speed;
}

/* The next reference. While the law does not command, it stays where the arm is, so that the motion goes on from there
 * as soon as the law is back. Then a spline leads to the start. Otherwise, a stream follows the steps. */
static void move_reference(plan *wanted, const arm_state *state, double time, arm_status last, const double q[N]) {
  int i;
  if (last == ARM_CAUGHT || last == ARM_RETURNING) {
    arm_reference_at(q, &wanted->reference);
    memcpy(wanted->target, wanted->start, sizeof wanted->target);
    wanted->found = wanted->reference;
    wanted->found_time = time;
  } else if (time < wanted->found_time + WAY_HOME) {
    arm_reference_spline(&wanted->found, wanted->start, WAY_HOME, time - wanted->found_time, &wanted->reference);
  } else {
    if (wanted->done < STEP_COUNT && time >= STEPS[wanted->done].time) {
      for (i = 0; i < K; ++i) wanted->target[i] = wanted->start[i] + STEPS[wanted->done].change[i];
      ++wanted->done;
    }
    arm_reference_stream(state, &wanted->reference, wanted->target, SMOOTHNESS, PERIOD);
  }
}

/* Answer to the status of a tick. */
static void answer(plan *wanted, arm_state *state, arm_status status, const double dq[N]) {
  switch (status) {
    case ARM_CAUGHT: /* wait until the arm has been at rest for a while, then ask for the law again */
      wanted->quiet = fastest(dq) < QUIET ? wanted->quiet + 1 : 0;
      if (wanted->quiet == PATIENCE) arm_resume(state);
      break;
    case ARM_NEAR_BOUNDARY: /* go no further */
      memcpy(wanted->target, wanted->reference.value, sizeof wanted->target);
      break;
    case ARM_BAD_INPUT: /* the law keeps the arm safe; a program for a robot reports this, and ends if it stays */
      break;
    default: /* OK, SATURATED, RETURNING: go on */
      wanted->quiet = 0;
      break;
  }
}

static void write_title(FILE *log) {
  static const char *const arrays[] = {"q", "dq", "torque", "phi", "reference"};
  size_t a;
  int i;
  fprintf(log, "time,status,push,contact");
  for (a = 0; a < sizeof arrays / sizeof *arrays; ++a)
    for (i = 0; i < N; ++i) fprintf(log, ",%s%d", arrays[a], i);
  fprintf(log, "\n");
}

static void write_numbers(FILE *log, const double *numbers, int count) {
  int i;
  for (i = 0; i < count; ++i) fprintf(log, ",%.9g", numbers[i]);
}

int main(int argc, char **argv) {
  const arm_safety *safety = &arm_default_safety;
  double q[N], dq[N], torque[N], phi[N], jacobian[N * N];
  arm_status status = ARM_OK;
  arm_state state;
  plan wanted;
  robot arm;
  FILE *log;
  long tick;
  int i;

  if (argc != 3) {
    fprintf(stderr, "usage: %s SCENE.xml LOG.csv\n", argv[0]);
    return 2;
  }
  if (!(arm_check() < 1e-9)) {
    fprintf(stderr, "the library computes other numbers here than where it was generated\n");
    return 2;
  }
  arm = open_robot(argv[1]);
  log = fopen(argv[2], "w");
  if (!log) {
    perror(argv[2]);
    return 2;
  }
  write_title(log);
  for (i = 0; i < N; ++i) q[i] = 0.5 * (arm_domain_lower[i] + arm_domain_upper[i]);
  place_robot(&arm, q);

  memset(&wanted, 0, sizeof wanted);
  wanted.found_time = -WAY_HOME;
  arm_reference_at(q, &wanted.reference);
  memcpy(wanted.start, wanted.reference.value, sizeof wanted.start);
  memcpy(wanted.target, wanted.reference.value, sizeof wanted.target);
  arm_start(&state, q, NULL);
  for (tick = 0; PERIOD * (double)tick < END; ++tick) {
    const double time = PERIOD * (double)tick, push = disturb(&arm, time);
    read_robot(&arm, q, dq);
    move_reference(&wanted, &state, time, status, q);
    status = arm_step(&state, safety, q, dq, &wanted.reference, &arm_default_gains, PERIOD, torque);
    answer(&wanted, &state, status, dq);
    (void)arm_chart(q, phi, jacobian);
    fprintf(log, "%.9g,%d,%.9g,%.9g", time, (int)status, push, contact(&arm));
    write_numbers(log, q, N);
    write_numbers(log, dq, N);
    write_numbers(log, torque, N);
    write_numbers(log, phi, N);
    write_numbers(log, wanted.reference.value, K);
    fprintf(log, "\n");
    write_robot(&arm, torque);
  }
  fclose(log);
  mj_deleteData(arm.data);
  mj_deleteModel(arm.model);
  return status == ARM_OK ? 0 : 1;
}
